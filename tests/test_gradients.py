"""Gradients of every public function of the core are finite."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from verbs import FORWARD, VERBS, numbers

pytestmark = pytest.mark.slow  # every verb is compiled several times: minutes


@pytest.fixture(autouse=True)
def drop_executables_of_each_verb():
    """This file compiles more than any other, each verb several times."""
    yield
    jax.clear_caches()


@pytest.mark.parametrize("name", VERBS)
def test_gradients_are_finite(name):
    verb, arguments = VERBS[name]
    inputs = arguments(0)
    dynamic, rest = eqx.partition(inputs, lambda x: eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating))

    def total(dynamic):
        return sum(
            (jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0)) for x in numbers(verb(*eqx.combine(dynamic, rest)))),
            jnp.zeros(()),
        )

    if name in FORWARD:
        _, gradient = eqx.filter_jit(lambda d: jax.jvp(total, (d,), (jax.tree.map(jnp.ones_like, d),)))(dynamic)
    else:
        gradient = eqx.filter_jit(jax.grad(total))(dynamic)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), f"{name}: {jax.tree_util.keystr(path)}"
