"""Every public verb of the core: jit = eager and vmap = loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from verbs import LOOSE, VERBS

from emgs_jax.ops.pytree import stack

pytestmark = pytest.mark.slow  # every verb is compiled several times: minutes


def assert_close(actual, expected, name):
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        if jnp.issubdtype(a.dtype, jnp.floating):
            # Fused sums round differently; the solver stops within its tolerance of 1e-4; and a depth's standard
            # deviation is the root of a difference, so that 1e-7 becomes 3e-4.
            scale = max(1.0, float(jnp.max(jnp.abs(jnp.where(jnp.isfinite(b), b, 0.0)), initial=0.0)))
            np.testing.assert_allclose(a, b, atol=(5e-3 if name in LOOSE else 1e-4) * scale, err_msg=name)
        elif name not in LOOSE:  # there, a point at a gate may pass it or not
            np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.parametrize("name", VERBS)
def test_jit_equals_eager_and_vmap_equals_a_loop(name):
    verb, arguments = VERBS[name]
    jitted = eqx.filter_jit(verb)
    loop = [jitted(*arguments(seed)) for seed in (0, 1)]
    assert_close(loop[0], verb(*arguments(0)), name)
    assert_close(eqx.filter_jit(eqx.filter_vmap(verb))(*stack([arguments(0), arguments(1)])), stack(loop), name)
