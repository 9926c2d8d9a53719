"""ICP against Gaussians by Levenberg–Marquardt."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import GaussianIndex, Gaussians
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.precision import full_precision
from emgs_jax.registration.depth_field import DepthField, depth_errors, depth_field
from emgs_jax.registration.matching import Candidates, Matches, surface_of
from emgs_jax.registration.noise import level_edges, levels_of, noise_of_levels, num_independent
from emgs_jax.registration.problem import (
    DISTRIBUTION,
    CoarseStart,
    IcpConfig,
    Problem,
    Uncertainty,
    candidates_at,
    distances,
    information_of_rows,
    information_of_surface,
    least_information,
    matches_at,
    pose_of,
    pose_problem,
    residuals,
)

MIN_COS = 0.3  # between a point's ray and its Gaussian's normal; below it the depth error is unknown

_Carry: TypeAlias = tuple[Float[Array, "7"], Uncertainty]


class IcpInfo(eqx.Module):
    """Result of the ICP solve: inliers, residuals, information and convergence.

    Args:
        num_inliers: points with a Gaussian that passes the gates.
        inlier_fraction: num_inliers over the points that take part.
        residual: root mean square distance of the inliers to their Gaussians' planes, as a fraction of their depth.
        misfit: the same fraction of all points within `max_misfit`, as 1.4826 times the median, a robust standard
            deviation; 0 without any.
        misfit_of_levels: likewise for the points in each level of confidence.
        level_edges: upper confidences of these levels.
        information: of the points alone, about (xi, log s).
        num_effective: number of independent measurements that the points amount to, see `num_independent`.
        min_eigenvalue: of the pose's information from prior, planes and colours, for translations in median depths and
            rotations in rad; its inverse is the variance of the least certain direction.
        field: of the frame's depth errors, see `depth_field`.
        num_steps: of all solves.
        is_converged: False if the last solve reached `max_steps` or failed.
    """

    num_inliers: Int[Array, ""]
    inlier_fraction: Float[Array, ""]
    residual: Float[Array, ""]
    misfit: Float[Array, ""]
    misfit_of_levels: Float[Array, "l"]
    level_edges: Float[Array, "e"]
    information: Float[Array, "7 7"]
    num_effective: Float[Array, ""]
    min_eigenvalue: Float[Array, ""]
    field: DepthField
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]


def _observed(
    y: Float[Array, "7"],
    matches: Matches,
    levels: Int[Array, "p"],
    problem: Problem,
    noise: Float[Array, ""],
    config: IcpConfig,
) -> tuple[Uncertainty, Float[Array, "p"], tuple[Float[Array, ""], Float[Array, "l"]]]:
    """Estimate the uncertainty from the points' distances to their Gaussians; `noise` is its lower bound.

    Returns:
        The uncertainty, the distances as fractions of the depth, and their spread over all points and in each level.
    """
    source = problem.source
    distance, is_near = distances(y, matches, problem, config)
    misfit, of_levels = noise_of_levels(distance, is_near, levels)
    depth = jnp.maximum(of_levels, noise)[levels]
    uncertainty = Uncertainty(
        common=noise * jnp.maximum(misfit / noise, 1.0),
        depth=depth,
        num_effective=num_independent(distance / depth, source.points, is_near),
    )
    return uncertainty, distance, (misfit, of_levels)


def _search_and_solve(
    carry: _Carry,
    look: tuple[Bool[Array, ""], Bool[Array, ""]],
    problem_of: Callable[[Uncertainty], Problem],
    levels: Int[Array, "p"],
    noise: Float[Array, ""],
    config: IcpConfig,
) -> tuple[_Carry, tuple[Candidates, Int[Array, ""], Bool[Array, ""]]]:
    """Look up the Gaussians near every point, measure how well the points fit them, and solve for y from there.

    Args:
        look: whether the misfit measured here counts for the coarse pose, and whether for the points.
    """
    (y, before), (is_first, is_new) = carry, look
    problem = problem_of(before)
    candidates = candidates_at(y, problem, config)
    seen, _, _ = _observed(y, matches_at(y, candidates, problem, config), levels, problem, noise, config)
    # Only at first is y the coarse pose; only then do the distances measure its quality.
    common = jnp.where(is_first, seen.common, before.common)
    uncertainty = jax.tree.map(partial(jnp.where, is_new), replace(seen, common=common), replace(before, common=common))
    # For seven unknowns, normal equations take a fraction of the time of a QR of all rows on a CPU.
    solver = optx.LevenbergMarquardt(
        rtol=config.tolerance, atol=config.tolerance, linear_solver=lineax.Normal(lineax.Cholesky())
    )
    args = candidates, problem_of(uncertainty), config
    solution = optx.least_squares(residuals, solver, y, args, max_steps=config.max_steps, throw=False)
    y = jnp.where(jnp.all(jnp.isfinite(solution.value)), solution.value, y)
    is_converged = solution.result == optx.RESULTS.successful
    return (y, uncertainty), (candidates, solution.stats["num_steps"], is_converged)


def _field(T: jaxlie.SE3, scale: Float[Array, ""], matches: Matches, problem: Problem, config: IcpConfig) -> DepthField:
    """Estimate the smooth part of the points' difference from their Gaussians, including points too far to fit."""
    placed = transform(T, problem.source, scale)
    errors, is_known = depth_errors(placed.points, matches.means, matches.normals, T.translation(), MIN_COS)
    is_known &= placed.valid & (jnp.abs(errors) < config.max_field)
    return depth_field(problem.source.points, errors, problem.depth_noise, is_known, config.field_length)


@full_precision
def icp(
    source: Observation,
    target: Gaussians,
    start: CoarseStart,
    config: IcpConfig,
    index: GaussianIndex | None = None,
) -> tuple[jaxlie.SE3, Float[Array, ""], IcpInfo]:
    """Register camera-frame `source` to `target`: argmin over xi and s of data + prior, T = T_world_coarse exp(xi).

    The data term is a truncated least-squares sum over the points, scaled to the weight of `num_effective` independent
    points. The prior pulls xi to 0 and the scale s of the points about the camera to 1, as strongly as `start` says:
    the predictions of one call share an error of scale, and only the map remembers the scale of earlier calls.

    The noise in `start` is a lower bound, because a prior may repeat itself exactly and still be wrong. If the points
    fit the map less well than that at the coarse pose, the coarse pose is trusted less; if they fit less well where
    they are looked up, so are the depths. A pose with a stated uncertainty keeps it: if its points do not fit, the
    error is theirs.

    Args:
        source: points to align, camera frame.
        target: Gaussians of the submap, world frame.
        index: of the target; None builds it here.

    Returns:
        T_world_camera, the scale, and what the solve found.
    """
    source = jax.tree.map(lambda leaf: leaf[:: max(leaf.shape[0] // config.num_points, 1)], source)
    surface = surface_of(target, config.residual != DISTRIBUTION, config.num_color_neighbours, index)

    def problem_of(uncertainty: Uncertainty) -> Problem:
        return pose_problem(source, surface, start, uncertainty, config)

    noise, edges = start.noise, level_edges(source.confidence, source.valid)
    levels = levels_of(source.confidence, edges)
    step = partial(_search_and_solve, problem_of=problem_of, levels=levels, noise=noise, config=config)
    given = Uncertainty(common=noise, depth=jnp.full(source.valid.shape, noise), num_effective=jnp.ones(()))
    is_first = jnp.arange(config.num_searches) == 0
    (y, uncertainty), rounds = jax.lax.scan(step, (jnp.zeros(7), given), (is_first, is_first | ~start.is_given))
    candidates, _, is_converged = jax.tree.map(lambda leaf: leaf[-1], rounds)
    problem = problem_of(uncertainty)
    matches = matches_at(y, candidates, problem, config)
    T, scale = pose_of(y, problem)
    seen, distance, (misfit, misfit_of_levels) = _observed(y, matches, levels, problem, noise, config)
    num_inliers = jnp.sum(matches.is_inlier)
    info = IcpInfo(
        num_inliers=num_inliers,
        inlier_fraction=num_inliers / jnp.maximum(jnp.sum(source.valid), 1),
        residual=jnp.sqrt(jnp.sum(jnp.where(matches.is_inlier, distance, 0.0) ** 2) / jnp.maximum(num_inliers, 1)),
        misfit=misfit,
        misfit_of_levels=misfit_of_levels,
        level_edges=edges,
        information=information_of_rows(y, matches, problem, config),
        num_effective=seen.num_effective,
        min_eigenvalue=least_information(information_of_surface(T, scale, matches, problem, config), problem),
        field=_field(T, scale, matches, problem, config),
        num_steps=jnp.sum(rounds[1]),
        is_converged=is_converged,
    )
    return T, scale, info
