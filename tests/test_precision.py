"""Every public function asks for matrix products in full float32 by itself: nobody sets it for the whole program.

By default JAX lets a GPU round the factors to ten bits, which no test on a CPU would notice.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from scene import random_gaussians
from test_transforms import VERBS

from emgs_jax.semantics import classify

CALLS = VERBS | {"classify": (classify, lambda s: (random_gaussians(9, s, 2), jnp.eye(2)))}
WITH_PRODUCTS = {
    *("transform", "fit_to_points", "cluster", "fit_rigid", "icp", "initialize", "localize_coarse", "localize_fine"),
    *("em_update", "split", "project_gaussians", "render", "densify", "refine", "judge", "join_layers", "classify"),
    *("relevance", "continued"),
    *("predict", "update", "deform", "move", "residuals", "linearize"),
}


@pytest.mark.parametrize("name", CALLS)
def test_every_matrix_product_of_a_verb_called_alone_is_in_full_float32(name):
    verb, arguments = CALLS[name]
    arrays, rest = eqx.partition(arguments(0), eqx.is_array)
    call = jax.jit(lambda arrays: eqx.filter(verb(*eqx.combine(arrays, rest)), eqx.is_array))
    products = [line for line in call.lower(arrays).as_text().splitlines() if "stablehlo.dot_general" in line]
    assert bool(products) == (name in WITH_PRODUCTS)
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)
