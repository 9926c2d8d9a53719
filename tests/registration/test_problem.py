"""The rows of ICP: what noise along the viewing rays does to the scale, and what is known before."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from compiled_rows import random_problem
from scene import at

from emgs_jax.ops.linalg import whitening
from emgs_jax.registration.belief import root_information
from emgs_jax.registration.problem import (
    COLORED,
    COLORED_RAY,
    IcpConfig,
    Uncertainty,
    data_information,
    pose_problem,
    rows_of,
)

DISTRIBUTION, STD, DEPTH_NOISE = 1, 0.01, 0.03


def noisy_problem():
    """Points that err by 3 % along their rays, each twice, and Gaussians of 1 cm where they truly are."""
    rng = np.random.default_rng(0)
    matches, problem = random_problem(rng)
    half, errors = len(problem.source.points) // 2, rng.normal(size=(len(problem.source.points) // 2, 1))
    twice = lambda rows: jnp.concatenate([rows[:half], rows[:half]])  # noqa: E731
    true, valid = twice(problem.source.points), twice(problem.source.valid)
    noisy = true * (1.0 + DEPTH_NOISE * jnp.asarray(np.concatenate([errors, -errors]), jnp.float32))
    to_world = problem.T_world_coarse.rotation().as_matrix()
    triangle, _ = whitening(jnp.broadcast_to(STD**2 * jnp.eye(3), (len(true), 3, 3)))
    matches = eqx.tree_at(
        lambda m: (m.means, m.triangle, m.noise, m.is_inlier),
        matches,
        (
            true @ to_world.T + problem.T_world_coarse.translation(),
            triangle,
            DEPTH_NOISE / STD * true @ to_world.T,
            valid,
        ),
    )
    one = jnp.ones(())
    fields = (lambda p: (p.source.points, p.source.valid, p.scale_unit, p.weight)), problem, (noisy, valid, one, one)
    return matches, eqx.tree_at(*fields)


def test_noise_along_the_rays_pulls_the_scale_nowhere(config):
    """The gradient by log s of half of the squares is Σ (ε² - ε²) = 0 for points p (1 + ν ε).

    With a noise that does not grow with the scale it is one for every point: a smaller cloud fits better.
    """
    settings = at(config("slam/localization=default").localization.icp, "residual", DISTRIBUTION)
    matches, problem = noisy_problem()
    cost = lambda y: 0.5 * jnp.sum(rows_of(y, matches, problem, settings) ** 2)  # noqa: E731
    gradient = jax.grad(cost)(jnp.zeros(7))[6] / jnp.sum(problem.source.valid)
    assert abs(float(gradient)) < 0.1


def test_depths_that_err_by_a_factor_pull_the_pose_nowhere_along_their_rays(config):
    """Points at p exp(± ν ε): half of the squares have no gradient. By their distances in metres all shrinks by ν²."""
    settings = config("slam/localization=default").localization.icp
    settings = at(settings, "color_std", 1e9)
    matches, problem = noisy_problem()
    true = (matches.means - problem.T_world_coarse.translation()) @ problem.T_world_coarse.rotation().as_matrix()
    half = len(true) // 2
    errors = jnp.exp(DEPTH_NOISE * jnp.asarray(np.random.default_rng(0).normal(size=(half, 1)), jnp.float32))
    noisy = true * jnp.concatenate([errors, 1.0 / errors])
    problem = eqx.tree_at(lambda p: (p.source.points, p.depth_noise), problem, (noisy, jnp.full(2 * half, DEPTH_NOISE)))
    twice = jnp.tile(matches.normals[:half], (2, 1))
    matches = eqx.tree_at(lambda m: (m.normals, m.plane_vars), matches, (twice, jnp.zeros(2 * half)))

    def step(residual: int) -> np.ndarray:
        """Of Gauss and Newton, with all of the solve's seven unknowns."""
        chosen = at(settings, "residual", residual)
        rows, jacobian = (f(jnp.zeros(7), matches, problem, chosen) for f in (rows_of, jax.jacfwd(rows_of)))
        rows, jacobian = np.asarray(rows, float).reshape(-1), np.asarray(jacobian, float).reshape(-1, 7)
        return np.linalg.lstsq(jacobian, -rows, rcond=None)[0]

    assert np.abs(step(COLORED_RAY)).max() < 0.01 * DEPTH_NOISE**2
    assert step(COLORED)[6] * float(problem.scale_unit) < -0.5 * DEPTH_NOISE**2


def test_the_information_of_the_points_does_not_depend_on_the_unit_of_the_seventh_unknown(config):
    settings = at(config("slam/localization=default").localization.icp, "residual", DISTRIBUTION)
    matches, problem = noisy_problem()
    found = data_information(jnp.zeros(7), matches, problem, settings)
    small = data_information(
        jnp.zeros(7), matches, eqx.tree_at(lambda p: p.scale_unit, problem, jnp.asarray(0.01)), settings
    )
    np.testing.assert_allclose(small, found, rtol=1e-3, atol=1e-3 * float(jnp.max(found)))
    still = data_information(
        jnp.zeros(7), matches, eqx.tree_at(lambda p: p.scale_unit, problem, jnp.asarray(0.0)), settings
    )
    assert not np.any(still[6]) and np.all(np.isfinite(still))


def test_what_is_known_is_the_prior_of_the_unknowns_and_worth_less_where_the_points_do_not_fit(config):
    settings = at(config("slam/localization=default").localization.icp, "scale_noise", 0.5)
    _, problem = noisy_problem()
    factor = jnp.asarray(np.random.default_rng(1).normal(size=(7, 7)) * 0.01, jnp.float32)
    known = root_information(factor @ factor.T + 1e-4 * jnp.eye(7))
    depth = jnp.full(problem.source.valid.shape, 0.02)

    def prior_of(worse: float, settings: IcpConfig) -> jax.Array:
        uncertainty = Uncertainty((jnp.asarray(0.05), jnp.asarray(0.02 * worse)), depth, jnp.ones(()))
        given = problem.source, problem.surface, problem.T_world_coarse, jnp.asarray(0.02)
        return pose_problem(*given, uncertainty, settings, known).prior

    y = jnp.linspace(-1.0, 1.0, 7)
    length = lambda root, x: float(jnp.linalg.norm(root @ x))  # noqa: E731
    expected = length(known, y.at[6].multiply(0.5 * 0.02))  # the seventh counts `scale_noise` of the depth noise
    np.testing.assert_allclose(length(prior_of(1.0, settings), y), expected, rtol=1e-4)
    np.testing.assert_allclose(length(prior_of(3.0, settings), y), expected / 3, rtol=1e-4)
    nothing = prior_of(1.0, at(settings, "prior_information", 0.0))
    assert not np.any(nothing[:6]) and nothing[6, 6] == 1  # as printed; a scale that no point moves stays
