"""ICP against Gaussians as one Levenberg–Marquardt solve."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians, intensity
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.linalg import Whitening, whiten, widen
from emgs_jax.ops.neighbours import knn
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, static, traced
from emgs_jax.registration.matching import Candidates, Matches, Surface, match, surface_of
from emgs_jax.registration.noise import confidence_levels, noise_of_levels, num_independent, robust_std

Noise: TypeAlias = tuple[Float[Array, ""], Float[Array, ""]]  # standard deviations in m, and in rad or over the depth
RESIDUALS = ("colored", "distribution", "colored+distribution")
COLORED, DISTRIBUTION = 0, 1


class IcpConfig(eqx.Module):
    """Terms, gates and limits of the solve (R9).

    Args:
        residual: `colored` (printed): distance to the Gaussian's plane and intensity difference (Park et al.,
            "Colored point cloud registration revisited", ICCV 2017); `distribution`: offset from the mean, whitened by
            the Gaussian's covariance; or `colored+distribution`: offset and intensity difference.
        color_std: standard deviation of intensity.
        noise: factor on the points' noise along their viewing rays, which widens every Gaussian for them.
        max_misfit: fraction of the depth; a point farther from its Gaussian's plane shows something else, and says
            nothing of the noise; 0 takes the noise as it is given.
        max_mahalanobis_sq: a point farther from all its neighbours than this is no inlier.
        min_normal_cos: nor one whose normal differs more from its Gaussian's.
        prior_information: of the coarse pose, in units of one effective point as noisy as the coarse step shows;
            0 = no prior, the printed form.
        scale_noise: standard deviation of the logarithm of the scale about the coarse step's, in units of the points'
            depth noise; 0 = no scale (printed).
        num_points: how many points take part.
        num_searches: how often the Gaussians near every point are looked up, each time with a solve after it.
        num_neighbours: Gaussians near a point, which every step of a solve compares.
        num_color_neighbours: Gaussians from which a Gaussian's intensity gradient is fitted.
        max_steps: of every solve.
        tolerance: relative and absolute, of the solver.
    """

    residual: Float[Array, "*b"] = choice(*RESIDUALS)
    color_std: Float[Array, "*b"] = traced()
    noise: Float[Array, "*b"] = traced()
    max_misfit: Float[Array, "*b"] = traced()
    max_mahalanobis_sq: Float[Array, "*b"] = traced()
    min_normal_cos: Float[Array, "*b"] = traced()
    prior_information: Float[Array, "*b"] = traced()
    scale_noise: Float[Array, "*b"] = traced()
    num_points: int = static()
    num_searches: int = static()
    num_neighbours: int = static()
    num_color_neighbours: int = static()
    max_steps: int = static()
    tolerance: float = static()


class IcpInfo(eqx.Module):
    """What the solve found.

    Args:
        num_inliers: points with a Gaussian that passes the gates.
        inlier_fraction: of the points that take part.
        residual: root mean square distance of the inliers to their Gaussians' planes, as a fraction of their depth.
        misfit: the same fraction of all points within `max_misfit`, as 1.4826 times the median, a robust standard
            deviation; 0 without any.
        misfit_of_levels: likewise of the points in each of the `confidence_levels`.
        num_effective: how many independent measurements the points are worth, see `num_independent`.
        min_eigenvalue: smallest eigenvalue of what planes and colours say of the pose, per effective point (1/m² and
            1/rad²). Offsets from means do not count: the mean of a Gaussian is no landmark of its surface.
        num_steps: of all solves.
        is_converged: False where the last solve reached `max_steps` or failed.
    """

    num_inliers: Int[Array, ""]
    inlier_fraction: Float[Array, ""]
    residual: Float[Array, ""]
    misfit: Float[Array, ""]
    misfit_of_levels: Float[Array, "l"]
    num_effective: Float[Array, ""]
    min_eigenvalue: Float[Array, ""]
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]


class _Uncertainty(eqx.Module):
    """What the coarse pose, the points' depths and all points together are worth."""

    pose: Noise
    depth: Float[Array, "p"]  # as a fraction
    num_effective: Float[Array, ""]


_Carry: TypeAlias = tuple[Float[Array, "7"], _Uncertainty]


class _Problem(eqx.Module):
    """What stays the same while the pose moves; lengths in metres."""

    source: Observation  # camera frame
    surface: Surface
    T_world_coarse: jaxlie.SE3
    rays: Float[Array, "p 3"]  # noise of every point along its viewing ray, camera frame
    scale_unit: Float[Array, ""]  # of the scale's logarithm, which is the seventh unknown
    prior: Float[Array, "7"]  # 1 / standard deviation of the unknowns
    weight: Float[Array, ""]  # of a point


def _pose_problem(
    source: Observation,
    surface: Surface,
    T_world_coarse: jaxlie.SE3,
    scale_unit: Float[Array, ""],
    uncertainty: _Uncertainty,
    config: IcpConfig,
) -> _Problem:
    prior = jnp.sqrt(config.prior_information) / jnp.repeat(jnp.stack(uncertainty.pose), 3)
    # Everything of a call errs with its scale, so the scale is held by the depths' common noise.
    common = jnp.sqrt(jnp.mean(uncertainty.depth**2))
    return _Problem(
        source=source,
        surface=surface,
        T_world_coarse=T_world_coarse,
        rays=config.noise * uncertainty.depth[:, None] * source.points,
        scale_unit=config.scale_noise * scale_unit,
        prior=jnp.append(prior, scale_unit / common),
        weight=uncertainty.num_effective / jnp.maximum(jnp.sum(source.valid), 1),
    )


def _pose(y: Float[Array, "7"], problem: _Problem) -> tuple[jaxlie.SE3, Float[Array, ""]]:
    """T_world_coarse exp(xi), and the scale exp(scale_unit · y_6)."""
    return problem.T_world_coarse @ jaxlie.SE3.exp(y[:6]), jnp.exp(problem.scale_unit * y[6])


def _search(y: Float[Array, "7"], problem: _Problem, config: IcpConfig) -> Candidates:
    """The Gaussians near every point, placed by the unknowns y."""
    T, scale = _pose(y, problem)
    target = problem.surface.gaussians
    return knn(transform(T, problem.source, scale).points, target.means, target.valid, config.num_neighbours)


def _match(y: Float[Array, "7"], candidates: Candidates, problem: _Problem, config: IcpConfig) -> Matches:
    """The Gaussian of every point at y."""
    T, scale = _pose(y, problem)
    placed, noise = transform(T, problem.source, scale), problem.rays @ T.rotation().as_matrix().T
    return match(placed, noise, candidates, problem.surface, (config.max_mahalanobis_sq, config.min_normal_cos))


def _distances(
    y: Float[Array, "7"], matches: Matches, problem: _Problem, config: IcpConfig
) -> tuple[Float[Array, "p"], Bool[Array, "p"]]:
    """Of every point to the plane of its Gaussian, as a fraction of its depth, and which show the same surface."""
    T, scale = _pose(y, problem)
    placed = transform(T, problem.source, scale)
    depth = jnp.where(placed.valid, scale * problem.source.points[:, 2], 1.0)
    distance = jnp.sum((placed.points - matches.means) * matches.normals, axis=-1) / depth
    return distance, placed.valid & (jnp.abs(distance) <= config.max_misfit)


def _residuals(
    y: Float[Array, "7"], args: tuple[Candidates, _Problem, IcpConfig]
) -> tuple[tuple[Float[Array, "p 5"], Float[Array, "7"]], Matches]:
    """Rows of every point and of the prior, in standard deviations; beside them the matches.

    The matches carry no gradient. The derivative is made here, once, and the solver gets rows that are linear in y:
    otherwise each of its uses of the derivative would be compiled, and computed, anew.
    """
    candidates, problem, config = args
    fixed = jax.lax.stop_gradient(y)
    matches = jax.lax.stop_gradient(_match(fixed, candidates, problem, config))
    jacobian = jax.lax.stop_gradient(jax.jacfwd(_rows)(fixed, matches, problem, config))
    rows = _rows(fixed, matches, problem, config) + jacobian @ (y - fixed)
    return (rows, problem.prior * y), matches


def _rows(y: Float[Array, "7"], matches: Matches, problem: _Problem, config: IcpConfig) -> Float[Array, "p 5"]:
    """Plane, colour and whitened offset of every point for given matches, in standard deviations."""
    T, scale = _pose(y, problem)
    placed = transform(T, problem.source, scale)
    offset = placed.points - matches.means
    plane = jnp.sum(offset * matches.normals, axis=-1) / matches.plane_std
    light = matches.light + jnp.sum(matches.gradients * offset, axis=-1)
    shade = (light - intensity(placed.colors)) / config.color_std
    triangle, noise, entries = (jnp.unstack(rows, axis=-1) for rows in (matches.triangle, matches.noise, offset))
    white = jnp.stack(widen(whiten(triangle, entries), noise), axis=-1)
    # A point beyond the gate costs what it would at the gate and pulls nowhere.
    edge = jnp.sqrt(config.max_mahalanobis_sq)
    is_inlier = matches.is_inlier[:, None]
    rows = jnp.concatenate(
        [
            (config.residual == COLORED) * jnp.where(is_inlier, plane[:, None], edge),
            (config.residual != DISTRIBUTION) * jnp.where(is_inlier, jnp.clip(shade, -edge, edge)[:, None], edge),
            (config.residual != COLORED) * jnp.where(is_inlier, white, edge / jnp.sqrt(3.0)),
        ],
        axis=-1,
    )
    valid = placed.valid
    return jnp.sqrt(problem.weight) * jnp.where(valid[:, None], rows, 0.0)


def _observed(
    y: Float[Array, "7"], matches: Matches, problem: _Problem, noise: Noise, config: IcpConfig
) -> tuple[_Uncertainty, Float[Array, "p"], tuple[Float[Array, ""], Float[Array, "l"]]]:
    """What the points' distances from their Gaussians say of the uncertainty, of which `noise` is the least.

    Returns:
        The uncertainty, the distances as fractions of the depth, and their spread: of all points, and of each level.
    """
    source = problem.source
    distance, is_near = _distances(y, matches, problem, config)
    levels = confidence_levels(source.confidence, source.valid)
    misfit, of_levels = robust_std(distance, is_near), noise_of_levels(distance, is_near, levels)
    depth = jnp.maximum(of_levels, noise[1])[levels]
    factor = jnp.maximum(misfit / noise[1], 1.0)
    uncertainty = _Uncertainty(
        pose=(noise[0] * factor, noise[1] * factor),
        depth=depth,
        num_effective=num_independent(distance / depth, source.points, is_near),
    )
    return uncertainty, distance, (misfit, of_levels)


def _search_and_solve(
    carry: _Carry,
    is_first: Bool[Array, ""],
    problem_of: Callable[[_Uncertainty], _Problem],
    noise: Noise,
    config: IcpConfig,
) -> tuple[_Carry, tuple[Matches, Int[Array, ""], Bool[Array, ""]]]:
    """Look up the Gaussians near every point, see how well the points fit them, and solve for y from there."""
    y, before = carry
    problem = problem_of(before)
    candidates = _search(y, problem, config)
    seen, _, _ = _observed(y, _match(y, candidates, problem, config), problem, noise, config)
    # y is the coarse pose at first, and only then do the distances say what that is worth.
    pose = jax.tree.map(lambda now, then: jnp.where(is_first, now, then), seen.pose, before.pose)
    uncertainty = _Uncertainty(pose=pose, depth=seen.depth, num_effective=seen.num_effective)
    # Seven unknowns: on a CPU the normal equations take a fraction of a QR of all rows.
    solver = optx.LevenbergMarquardt(
        rtol=config.tolerance, atol=config.tolerance, linear_solver=lineax.Normal(lineax.Cholesky())
    )
    args = candidates, problem_of(uncertainty), config
    solution = optx.least_squares(_residuals, solver, y, args, has_aux=True, max_steps=config.max_steps, throw=False)
    y = jnp.where(jnp.all(jnp.isfinite(solution.value)), solution.value, y)
    is_converged = solution.result == optx.RESULTS.successful
    # Not `solution.aux`, which lags one accepted step behind.
    return (y, uncertainty), (solution.state.aux, solution.stats["num_steps"], is_converged)


@full_precision
def icp(
    source: Observation,
    target: Gaussians,
    T_world_coarse: jaxlie.SE3,
    noise: Noise,
    config: IcpConfig,
    white: Whitening | None = None,
) -> tuple[jaxlie.SE3, Float[Array, ""], IcpInfo]:
    """Place camera-frame `source` on `target`: argmin over xi and s of data + prior, T = T_world_coarse exp(xi).

    The data term is a truncated least-squares sum over the points, scaled so that all of them together weigh as much
    as `num_effective` independent ones. The prior holds xi at 0 with `prior_information`, and the scale s of the
    points about the camera at 1 with `scale_noise`: the predictions of one call share an error of scale, and only the
    map remembers the scale of the calls before.

    `noise` is a lower bound. Where the points do not fit the map at the coarse pose as well as that, the coarse pose is
    worth no more than they fit there, and the depths no more than they fit where they are looked up: a prior may repeat
    itself exactly and still err.

    Args:
        source: points to align, camera frame.
        target: Gaussians of the submap, world frame.
        T_world_coarse: where to start, and the mean of the prior.
        noise: standard deviation of the coarse pose in metres, and of the points' depth as a fraction of it.
        config: terms and gates.
        white: `whitening` of the target's covariances; None makes it here.

    Returns:
        T_world_camera, the scale, and what the solve found.
    """
    stride = max(source.valid.shape[0] // config.num_points, 1)
    source = jax.tree.map(lambda leaf: leaf[::stride], source)
    surface = surface_of(target, config.residual != DISTRIBUTION, config.num_color_neighbours, white)

    def problem_of(uncertainty: _Uncertainty) -> _Problem:
        return _pose_problem(source, surface, T_world_coarse, noise[1], uncertainty, config)

    def search_and_solve(carry: _Carry, is_first: Bool[Array, ""]) -> tuple[_Carry, tuple]:
        return _search_and_solve(carry, is_first, problem_of, noise, config)

    given = _Uncertainty(pose=noise, depth=jnp.full(source.valid.shape, noise[1]), num_effective=jnp.ones(()))
    is_first = jnp.arange(config.num_searches) == 0
    (y, uncertainty), rounds = jax.lax.scan(search_and_solve, (jnp.zeros(7), given), is_first)
    matches, _, is_converged = jax.tree.map(lambda leaf: leaf[-1], rounds)
    problem = problem_of(uncertainty)
    T, scale = _pose(y, problem)
    seen, distance, (misfit, misfit_of_levels) = _observed(y, matches, problem, noise, config)
    num_inliers = jnp.sum(matches.is_inlier)
    info = IcpInfo(
        num_inliers=num_inliers,
        inlier_fraction=num_inliers / jnp.maximum(jnp.sum(source.valid), 1),
        residual=jnp.sqrt(jnp.sum(jnp.where(matches.is_inlier, distance, 0.0) ** 2) / jnp.maximum(num_inliers, 1)),
        misfit=misfit,
        misfit_of_levels=misfit_of_levels,
        num_effective=seen.num_effective,
        min_eigenvalue=jnp.linalg.eigvalsh(_information(T, scale, matches, problem, config))[0],
        num_steps=jnp.sum(rounds[1]),
        is_converged=is_converged,
    )
    return T, scale, info


def _information(
    T: jaxlie.SE3, scale: Float[Array, ""], matches: Matches, problem: _Problem, config: IcpConfig
) -> Float[Array, "6 6"]:
    """What planes and colours of the inliers say of the pose, per point: Σ j j' / p with j = (a, x × a) / std.

    a is the normal, or the gradient of the intensity, and x the point, both in the camera's axes.
    """
    points, to_camera = scale * problem.source.points, T.rotation().as_matrix()
    normals, gradients = matches.normals @ to_camera, matches.gradients @ to_camera
    has_color = config.residual != DISTRIBUTION
    axes = jnp.concatenate([normals / matches.plane_std[:, None], has_color * gradients / config.color_std])
    rows = jnp.concatenate([axes, jnp.cross(jnp.concatenate([points, points]), axes)], axis=-1)
    rows = jnp.where(jnp.concatenate([matches.is_inlier] * 2)[:, None], rows, 0.0)
    return rows.T @ rows / jnp.maximum(jnp.sum(problem.source.valid), 1)
