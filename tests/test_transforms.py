"""Every public verb of the core under JAX's transforms: a batch, a derivative, and what is asked of matrix products.

Each verb is compiled twice, with its derivative and for a batch, which all three tests share. That its values are right
is what the tests of its own file say.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import stack
from verbs import FORWARD, INSIDE_ANOTHER, LOOSE, ROWS_TOGETHER, VERBS

pytestmark = pytest.mark.slow  # every verb is compiled twice: minutes
NAMES = [pytest.param(name, marks=pytest.mark.weekly if name in INSIDE_ANOTHER | FORWARD else ()) for name in VERBS]
STEPS = (1e-3, 3e-4)  # parts of each array's largest entry; float32 rounds a quotient by the second to 2e-4


def is_number(x) -> bool:
    return eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating)


def numbers(tree) -> list:
    return [leaf for leaf in jax.tree.leaves(tree) if is_number(leaf)]


def direction_of(inputs, rows_together: bool):
    """For every entry of the arrays of numbers a part of the largest, or every array grown by a part of itself."""
    rng = np.random.default_rng(0)

    def part(x):
        return rng.uniform(-1, 1) * x if rows_together else rng.uniform(-1, 1, x.shape) * np.abs(x).max(initial=0.0)

    # What is NaN is not known, and no number near it is an input of the same kind.
    return jax.tree.map(lambda x: np.where(np.isnan(x), 0.0, part(x)).astype(np.float32), inputs)


class Verb:
    """A verb's results: of two inputs one by one, and of a batch of them and of steps to and fro from the first."""

    def __init__(self, name: str) -> None:
        self.name, (self.verb, arguments) = name, VERBS[name]
        self.inputs = [eqx.partition(jax.device_get(arguments(seed)), is_number) for seed in (0, 1)]
        (first, others), second = self.inputs
        self.direction = direction_of(first, name in ROWS_TOGETHER)
        moved = [
            (jax.tree.map(lambda x, d, step=step: x + np.float32(step) * d, first, self.direction), others)
            for size in STEPS
            for step in (size, -size)
        ]
        batch = jax.device_get(stack([(first, others), second, *moved]))
        rows = jax.device_get(eqx.filter_jit(eqx.filter_vmap(self.call))(*batch))
        self.batch = [jax.tree.map(lambda x, i=i: x[i], rows) for i in range(2 + len(moved))]
        self.weights, self.slopes = self.differences()
        if name in FORWARD:
            self.program = self.lowered(self.call)
            self.results = [jax.device_get(self.program(*inputs)) for inputs in self.inputs]
        else:
            self.program = self.lowered(self.backward, self.weights)
            found = [jax.device_get(self.program(*inputs, self.weights)) for inputs in self.inputs]
            self.results, self.gradient = [results for results, _ in found], found[0][1]

    def call(self, numbers, others):
        return self.verb(*eqx.combine(numbers, others))

    def backward(self, inputs, others, weights):
        """Results, and the gradient of their weighted sum."""

        def total(inputs):
            results = self.call(inputs, others)
            parts = zip(numbers(results), weights, strict=True)
            return sum((jnp.sum(jnp.where(w != 0, x, 0.0) * w) for x, w in parts), jnp.zeros(())), results

        (_, results), gradient = jax.value_and_grad(total, has_aux=True)(inputs)
        return results, gradient

    def forward(self, inputs, others, direction):
        """Derivatives of all results along the direction."""
        return jax.jvp(lambda x: numbers(self.call(x, others)), (inputs,), (direction,))[1]

    def lowered(self, function, *more):
        lowered = eqx.filter_jit(function).lower(*self.inputs[0], *more)
        self.text = lowered.as_text()
        return lowered.compile()

    def differences(self):
        """For each array of results: weights of about one over its largest entry, and finite differences.

        Both are 0 where the differences by two steps do not agree, or steps to and fro lie on one side of the result:
        such an entry is at a gate or at an edge, or neighbours have changed their order.
        """
        weights, slopes = [], []
        for x, *moved in zip(*map(numbers, (self.batch[0], *self.batch[2:])), strict=True):
            unit = 1.0 + np.abs(np.where(np.isfinite(x), x, 0.0)).max(initial=0.0)
            with np.errstate(invalid="ignore"):
                large, small = ((moved[2 * i] - moved[2 * i + 1]).astype(float) / (2 * STEPS[i]) for i in (0, 1))
                is_smooth = np.abs(large - small) <= 0.05 * np.abs(large) + 2e-3 * unit
                is_smooth &= np.abs(0.5 * (moved[0] + moved[1]) - x) <= 1e-3 * unit
            slopes.append(np.where(is_smooth, large, 0.0))
            weights.append((is_smooth * np.cos(np.arange(x.size)).reshape(x.shape) / unit).astype(np.float32))
        return weights, slopes


compiled = cache(Verb)


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_is_its_items_one_by_one(name):
    """Fused sums round differently; the solver stops within its tolerance of 1e-4; and a depth's standard deviation is
    the root of a difference, so that 1e-7 becomes 3e-4."""
    verb = compiled(name)
    for found, expected in zip(verb.batch, verb.results, strict=False):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            if is_number(a):
                scale = max(1.0, np.abs(np.where(np.isfinite(b), b, 0.0)).max(initial=0.0))
                np.testing.assert_allclose(a, b, atol=(5e-3 if name in LOOSE else 1e-4) * scale, err_msg=name)
            elif name in LOOSE:  # a point at a gate may pass it or not
                assert np.mean(a != b) <= 0.02, (name, a, b)
            else:
                np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.parametrize("name", NAMES)
def test_the_derivative_is_that_of_a_finite_difference(name):
    """Along a random direction of all inputs, of a sum of all results with random weights; and it is finite."""
    verb = compiled(name)
    num_smooth, num_all = (sum(count(w) for w in verb.weights) for count in (np.count_nonzero, np.size))
    assert num_smooth >= 0.9 * num_all, (num_smooth, num_all)
    if name in FORWARD:
        found = jax.device_get(eqx.filter_jit(verb.forward)(*verb.inputs[0], verb.direction))
        assert all(np.isfinite(x).all() for x in found)
        slope = sum(float(np.sum(w.astype(float) * x)) for w, x in zip(verb.weights, found, strict=True))
    else:
        for path, leaf in jax.tree_util.tree_leaves_with_path(verb.gradient):
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
        pairs = zip(*map(jax.tree.leaves, (verb.gradient, verb.direction)), strict=True)
        slope = sum(float(np.sum(a.astype(float) * b)) for a, b in pairs)
    parts = np.concatenate([[0.0], *((w * d).ravel() for w, d in zip(verb.weights, verb.slopes, strict=True))])
    # Of a sum of so many parts with random signs the size is that of their squares' sum, for rounding too.
    assert abs(slope - parts.sum()) <= 0.03 * np.linalg.norm(parts) + 1e-3 * num_all**0.5, (slope, parts.sum())


@pytest.mark.parametrize("name", NAMES)
def test_every_matrix_product_of_a_verb_called_alone_is_in_full_float32(name):
    """By default JAX lets a GPU round the factors to ten bits, which no test on a CPU would notice."""
    products = [line for line in compiled(name).text.splitlines() if "stablehlo.dot_general" in line]
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)
    assert products or name not in ("transform", "fit_rigid", "classify")  # so that the words are those that JAX uses
