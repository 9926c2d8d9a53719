"""Compares the compiled derivative of ICP's rows with that by each unknown alone; exits with 1 where they differ.

For a version of JAX by itself; `test_optimized.py` does the same.
"""

import sys

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax import load_config
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.ops.neighbours import group_points
from emgs_jax.registration.matching import Matches, Surface
from emgs_jax.registration.problem import Problem, rows_of

NUM_POINTS = 4800  # as a run has: jaxlib 0.10.2 is right for fewer


def random_problem(rng: np.random.Generator) -> tuple[Matches, Problem]:
    """Points within a few centimetres of their Gaussians, two thirds of them inliers."""

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    def unit(*shape: int) -> jax.Array:
        values = rng.normal(size=shape)
        return jnp.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True), jnp.float32)

    points = normal(NUM_POINTS, 3) + jnp.array([0.0, 0.0, 3.0])
    T = jaxlie.SE3.exp(jnp.array([0.2, -0.1, 0.3, 0.1, 0.5, -0.2]))
    valid = jnp.asarray(rng.random(NUM_POINTS) < 0.9)
    colors = jnp.asarray(rng.random((NUM_POINTS, 3)), jnp.float32)
    source = Observation(points, colors, unit(NUM_POINTS, 3), jnp.zeros((NUM_POINTS, 0)), jnp.ones(NUM_POINTS), valid)
    diagonal = jnp.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    matches = Matches(
        means=points @ T.rotation().as_matrix().T + T.translation() + 0.03 * normal(NUM_POINTS, 3),
        normals=unit(NUM_POINTS, 3),
        triangle=50.0 * (diagonal + 0.1 * normal(NUM_POINTS, 6)),
        noise=normal(NUM_POINTS, 3),
        plane_vars=jnp.full(NUM_POINTS, 1e-4),
        plane_std=jnp.full(NUM_POINTS, 0.02),
        light=jnp.asarray(rng.random(NUM_POINTS), jnp.float32),
        gradients=normal(NUM_POINTS, 3),
        is_inlier=jnp.asarray(rng.random(NUM_POINTS) < 2 / 3),
    )
    units = jnp.ones(7).at[6].set(0.005)
    one, zeros = jnp.ones(()), jnp.zeros((1, 3))
    nothing = Gaussians(zeros, jnp.eye(3)[None], zeros, zeros, jnp.zeros((1, 0)), jnp.zeros(1, bool))
    groups = group_points(nothing.means, nothing.valid)
    surface = Surface(
        nothing, groups, jnp.zeros((1, 6)), one[None], one[None], zeros
    )  # what is matched does not look at it
    return matches, Problem(source, surface, T, jnp.full(NUM_POINTS, 0.01), units, jnp.eye(7), 0.01 * one)


def largest_difference(matches: Matches, problem: Problem, options: dict | None = None) -> float:
    """Of any entry, as a fraction of its column's largest; `options` of the compiler are those of the derivative."""
    settings = load_config().slam.localization.icp
    y = jnp.asarray(np.random.default_rng(1).normal(size=7) * 0.01, jnp.float32)

    def rows(y: jax.Array) -> jax.Array:
        return rows_of(y, matches, problem, settings)

    def along(y: jax.Array, direction: jax.Array) -> jax.Array:
        return jax.jvp(rows, (y,), (direction,))[1]

    together = jax.jit(jax.jacfwd(rows)).lower(y).compile(options)(y)
    plain = jax.jit(along).lower(y, y).compile({"xla_backend_optimization_level": 0})
    alone = np.stack([plain(y, direction) for direction in np.eye(7, dtype=np.float32)], axis=-1)
    return float(np.max(np.abs(together - alone) / np.max(np.abs(alone), axis=(0, 1))))


if __name__ == "__main__":
    difference = largest_difference(*random_problem(np.random.default_rng(0)))
    print(f"jax {jax.__version__}: {difference:.1e}")
    sys.exit(difference > 1e-4)
