"""The rows of ICP: what noise along the viewing rays does to the scale, and what is known before."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_rows import random_problem
from scene import at, device, matrix_of, on_host

from emgs_jax.ops.linalg import whitening
from emgs_jax.registration import problem as problems
from emgs_jax.registration.pose_estimate import root_information
from emgs_jax.registration.problem import (
    COLORED,
    COLORED_RAY,
    RESIDUALS,
    CoarseStart,
    IcpConfig,
    Problem,
    Uncertainty,
    pose_problem,
)

information_of_rows, rows_of = on_host(problems.information_of_rows), on_host(problems.rows_of)
pose_information = on_host(problems.information_of_surface)
jacobian_of = on_host(jax.jacfwd(problems.rows_of))
NOWHERE = np.zeros(7, np.float32)
DISTRIBUTION, STD, DEPTH_NOISE = 1, 0.01, 0.03


def noisy_problem():
    """Points that err by 3 % along their rays, each twice, and Gaussians of 1 cm where they truly are."""
    rng = np.random.default_rng(0)
    matches, problem = random_problem(rng)
    points, valid = (np.asarray(x) for x in (problem.source.points, problem.source.valid))
    half, errors = len(points) // 2, rng.normal(size=(len(points) // 2, 1))
    true, valid = np.tile(points[:half], (2, 1)).astype(float), np.tile(valid[:half], 2)
    noisy = true * (1.0 + DEPTH_NOISE * np.concatenate([errors, -errors]))
    matrix = matrix_of(problem.T_world_coarse)
    placed = true @ matrix[:3, :3].T
    triangle, _ = on_host(whitening)(np.float32(np.tile(STD**2 * np.eye(3), (len(true), 1, 1))))
    matches = eqx.tree_at(
        lambda m: (m.means, m.triangle, m.noise, m.is_inlier),
        matches,
        tuple(map(device, (placed + matrix[:3, 3], triangle, DEPTH_NOISE / STD * placed, valid))),
    )
    fields = lambda p: (p.source.points, p.source.valid, p.units, p.weight)  # noqa: E731
    return matches, eqx.tree_at(fields, problem, tuple(map(device, (noisy, valid, np.ones(7), 1.0))))


@pytest.mark.slow
def test_noise_along_the_rays_pulls_the_scale_nowhere(config):
    """The gradient by log s of half of the squares is Σ (ε² - ε²) = 0 for points p (1 + ν ε).

    With a noise that does not grow with the scale it is one for every point: a smaller cloud fits better.
    """
    settings = at(config("slam/localization=default").localization.icp, "residual", DISTRIBUTION)
    matches, problem = noisy_problem()
    given = NOWHERE, matches, problem, settings
    gradient = np.einsum("prk,pr->k", jacobian_of(*given).astype(float), rows_of(*given))  # of half of the squares
    assert abs(gradient[6]) / np.sum(problem.source.valid) < 0.1


def test_depths_that_err_by_a_factor_pull_the_pose_nowhere_along_their_rays(config):
    """Points at p exp(± ν ε): half of the squares have no gradient. By their distances in metres all shrinks by ν²."""
    settings = config("slam/localization=default").localization.icp
    settings = at(settings, "color_std", 1e9)
    matches, problem = noisy_problem()
    matrix = matrix_of(problem.T_world_coarse)
    true = (np.asarray(matches.means, float) - matrix[:3, 3]) @ matrix[:3, :3]
    half = len(true) // 2
    errors = np.exp(DEPTH_NOISE * np.random.default_rng(0).normal(size=(half, 1)))
    arrays = true * np.concatenate([errors, 1.0 / errors]), np.full(2 * half, DEPTH_NOISE)
    problem = eqx.tree_at(lambda p: (p.source.points, p.depth_noise), problem, tuple(map(device, arrays)))
    arrays = np.tile(np.asarray(matches.normals)[:half], (2, 1)), np.zeros(2 * half)
    matches = eqx.tree_at(lambda m: (m.normals, m.plane_vars), matches, tuple(map(device, arrays)))

    def step(residual: int) -> np.ndarray:
        """Of Gauss and Newton, with all of the solve's seven unknowns."""
        chosen = at(settings, "residual", residual)
        rows, jacobian = (f(NOWHERE, matches, problem, chosen) for f in (rows_of, jacobian_of))
        rows, jacobian = np.asarray(rows, float).reshape(-1), np.asarray(jacobian, float).reshape(-1, 7)
        return np.linalg.lstsq(jacobian, -rows, rcond=None)[0]

    assert np.abs(step(COLORED_RAY)).max() < 0.01 * DEPTH_NOISE**2
    assert step(COLORED)[6] * float(problem.units[6]) < -0.5 * DEPTH_NOISE**2


def test_the_information_of_the_points_is_that_of_their_rows_whatever_the_unit_of_the_seventh_unknown(config):
    settings = at(config("slam/localization=default").localization.icp, "residual", DISTRIBUTION)
    matches, problem = noisy_problem()
    found, small, still = (
        information_of_rows(NOWHERE, matches, eqx.tree_at(lambda p: p.units, problem, device(units)), settings)
        for units in (np.ones(7), np.array([3.0] * 3 + [1.0] * 3 + [0.01]), np.append(np.ones(6), 0.0))
    )
    jacobian = jacobian_of(NOWHERE, matches, problem, settings).astype(float).reshape(-1, 7)  # its unit is 1
    np.testing.assert_allclose(found, jacobian.T @ jacobian, rtol=1e-3, atol=1e-3 * found.max())
    np.testing.assert_allclose(small, found, rtol=1e-3, atol=1e-3 * found.max())
    assert not np.any(still[6]) and np.all(np.isfinite(still))


def test_what_is_known_is_the_prior_of_the_unknowns_and_worth_less_where_the_points_do_not_fit(config):
    settings = at(config("slam/localization=default").localization.icp, "scale_noise", 0.5)
    _, problem = noisy_problem()
    factor = np.random.default_rng(1).normal(size=(7, 7)) * 0.01
    known = on_host(root_information)(np.float32(factor @ factor.T + 1e-4 * np.eye(7)))

    @on_host
    def problem_of(noise, known, is_given, settings: IcpConfig) -> Problem:
        uncertainty = Uncertainty(noise, jnp.full(problem.source.valid.shape, 0.02), jnp.ones(()))
        start = CoarseStart(problem.T_world_coarse, known, jnp.asarray(0.02), is_given)
        return pose_problem(problem.source, problem.surface, start, uncertainty, settings)

    def made(worse: float, is_given: bool = False, chosen: IcpConfig = settings) -> Problem:
        return problem_of(np.float32(0.02 * worse), known, np.array(is_given), chosen)

    points, valid = np.asarray(problem.source.points), np.asarray(problem.source.valid)
    depth = np.sort(points[valid, 2])[(valid.sum() - 1) // 2]
    units = np.array([depth] * 3 + [1.0] * 3 + [0.5 * 0.02])  # the last counts `scale_noise` of the depth noise
    np.testing.assert_allclose(made(1.0).units, units, rtol=1e-6)
    np.testing.assert_allclose(made(1.0).depth_noise, settings.noise * 0.02, rtol=1e-6)
    y = np.linspace(-1.0, 1.0, 7)
    for worse in (1.0, 3.0):
        expected = np.linalg.norm(known @ (units * y)) / worse
        np.testing.assert_allclose(np.linalg.norm(made(worse).prior @ y), expected, rtol=1e-4)
        # Of a pose that comes with its uncertainty they say nothing, and of the scale as much as ever.
        expected = np.linalg.norm(known @ (units * y / np.append(np.ones(6), worse)))
        np.testing.assert_allclose(np.linalg.norm(made(worse, True).prior @ y), expected, rtol=1e-4)
    nothing = made(1.0, True, at(settings, "prior_information", 0.0)).prior
    assert not np.any(nothing[:6]) and nothing[6, 6] == 1  # as printed; a scale that no point moves stays


@pytest.mark.parametrize("reading", range(len(RESIDUALS)))
def test_a_point_beyond_the_gate_costs_what_it_would_at_the_gate_and_informs_nobody(config, reading):
    """Of a point's rows those of place are the gate's edge together, and that of colour is it as well."""
    settings = at(config("slam/localization=default").localization.icp, "residual", reading)
    matches, problem = random_problem(np.random.default_rng(0))
    given = NOWHERE, matches, problem, settings
    valid = np.asarray(problem.source.valid)
    outlier = valid & ~np.asarray(matches.is_inlier)
    assert not valid.all() and not rows_of(*given)[~valid].any(), "and one that is not valid costs nothing"
    rows = rows_of(*given)[outlier] ** 2 / float(problem.weight) / float(settings.max_mahalanobis_sq)
    np.testing.assert_allclose(rows[:, [0, 2, 3, 4]].sum(1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(rows[:, 1], float(reading != DISTRIBUTION), rtol=1e-5)
    far = eqx.tree_at(lambda m: m.normals, matches, device(np.where(outlier[:, None], 1e3, matches.normals)))
    one, other = (pose_information(problem.T_world_coarse, np.float32(1), m, problem, settings) for m in (matches, far))
    np.testing.assert_array_equal(one, other)
