"""Cost function of ICP: distances of points from Gaussians in standard deviations, and the prior on the pose."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.gaussians import intensity
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.linalg import whiten, widen
from emgs_jax.ops.neighbours import nearest
from emgs_jax.ops.pytree import choice, static, traced
from emgs_jax.registration.matching import Candidates, Matches, Surface, match
from emgs_jax.registration.rigid import median

RESIDUALS = ("colored", "distribution", "colored+distribution", "colored+ray")
COLORED, DISTRIBUTION, _, COLORED_RAY = range(len(RESIDUALS))
LEAST_PLANE = 1e-6  # smallest distance of a plane from the camera, as a fraction of the point's
LEAST_RATIO = 1e-3  # of a point's depth to that of a plane; less is behind the camera


class IcpConfig(eqx.Module):
    """Terms, gates and limits of the solve (R9).

    Args:
        residual: `colored` (printed): distance to the Gaussian's plane and intensity difference (Park et al.,
            "Colored point cloud registration revisited", ICCV 2017); `distribution`: offset from the mean, whitened by
            the Gaussian's covariance; `colored+distribution`: offset and intensity difference; or `colored+ray`: depth
            along the viewing ray over that of the Gaussian's plane, and intensity difference.
        noise: factor on the points' noise along their viewing rays, which widens the Gaussians they are compared with.
        max_misfit: fraction of the depth; a point farther from its Gaussian's plane shows something else and does not
            count in the noise; 0 uses the given noise.
        max_mahalanobis_sq: a point farther than this from all its neighbours is no inlier.
        min_normal_cos: nor is one whose normal differs more from its Gaussian's.
        prior_information: of the coarse pose, in units of one effective point with the noise of the coarse step; 0 = no
            prior, the printed form.
        scale_noise: standard deviation of the log-scale about the coarse step's, in units of the points' depth noise,
            if nothing else is known; 0 = no scale (printed).
        max_field: of a logarithm of depth; a larger difference from the map is another surface and does not count in
            the field of depth errors; 0: no field (printed).
        field_length: correlation length of the field, as a fraction of the image's side.
        num_points: least number of points: every n-th one takes part, with the largest n that leaves this many.
        num_searches: how often the Gaussians near every point are looked up, each time followed by a solve.
        num_neighbours: Gaussians near a point that every step of a solve compares.
        num_color_neighbours: Gaussians to which a Gaussian's intensity gradient is fitted.
        tolerance: relative and absolute, of the solver; its lower bound is the resolution of float32.
    """

    residual: Float[Array, "*b"] = choice(*RESIDUALS)
    prior_information: Float[Array, "*b"] = traced(low=0, high=1e9)
    scale_noise: Float[Array, "*b"] = traced(low=0, high=1000)
    max_field: Float[Array, "*b"] = traced(low=0, high=10)
    color_std: Float[Array, "*b"] = traced(0.1, low=0.0001)
    noise: Float[Array, "*b"] = traced(1.0, low=0)
    max_misfit: Float[Array, "*b"] = traced(0.1, low=0)
    max_mahalanobis_sq: Float[Array, "*b"] = traced(9.0, low=0, high=math.inf)
    min_normal_cos: Float[Array, "*b"] = traced(0.5, low=-math.inf, high=1)
    field_length: Float[Array, "*b"] = traced(0.3, low=1e-3, high=100)
    num_points: int = static(3200, low=1, high=2**24)
    num_searches: int = static(2, low=1, high=100)
    num_neighbours: int = static(8, low=1, high=256)
    num_color_neighbours: int = static(12, low=1, high=256)
    max_steps: int = static(4, low=0, high=1000)
    tolerance: float = static(0.0001, low=1e-7, high=1)


class Uncertainty(eqx.Module):
    """Uncertainty of the coarse pose and of the points' depths, and the effective number of points."""

    common: Float[Array, ""]  # depth noise of all, see `pose_worth`
    depth: Float[Array, "p"]  # noise of each, as a fraction
    num_effective: Float[Array, ""]


class CoarseStart(eqx.Module):
    """Start of ICP, and what is known before it looks at the points.

    Args:
        T_world_coarse: initial pose, and mean of the prior on it.
        root_information: root of the information about (xi, log s) if the points fit as expected.
        noise: smallest standard deviation of the points' depth, as a fraction of it.
        is_given: the prior states the uncertainty of the pose, see `pose_worth`.
    """

    T_world_coarse: jaxlie.SE3
    root_information: Float[Array, "7 7"]
    noise: Float[Array, ""]
    is_given: Bool[Array, ""]


class Problem(eqx.Module):
    """Constants of the ICP problem while the pose changes; lengths in metres, unknowns in units of their own."""

    source: Observation  # camera frame
    surface: Surface
    T_world_coarse: jaxlie.SE3
    depth_noise: Float[Array, "p"]  # of every point along its viewing ray, as a fraction
    units: Float[Array, "7"]  # (xi, log s) per unit of an unknown; 0 for a fixed scale
    prior: Float[Array, "7 7"]  # root of the information of the coarse pose and scale, by the unknowns
    weight: Float[Array, ""]  # of a point


def pose_worth(is_given: Bool[Array, ""], misfit: Float[Array, ""], depth_noise: Float[Array, ""]) -> Float[Array, "7"]:
    """Return factors on the standard deviations of a coarse pose and scale whose points do not fit as expected.

    The misfit says nothing about a pose with a stated uncertainty.

    Args:
        is_given: the prior states the uncertainty of the pose.
        misfit: of the points, as a fraction of the depth.
        depth_noise: expected, likewise.
    """
    worse = jnp.maximum(misfit / depth_noise, 1.0)
    return jnp.full(7, jnp.where(is_given, 1.0, worse)).at[6].set(worse)


def pose_problem(
    source: Observation,
    surface: Surface,
    start: CoarseStart,
    uncertainty: Uncertainty,
    config: IcpConfig,
) -> Problem:
    """Build the ICP problem of points and map.

    Translation is measured in median depths, so that the solver's damping and tolerance mean the same in every unit of
    length, and the seventh unknown in units of the depth noise.
    """
    depth = median(source.points[:, 2], source.valid)
    units = jnp.ones(7).at[:3].set(depth).at[6].set(config.scale_noise * start.noise)
    worth = pose_worth(start.is_given, uncertainty.common, start.noise)
    prior = (config.prior_information > 0) * start.root_information * units / worth
    prior = prior.at[6, 6].set(jnp.where(units[6] * prior[6, 6] > 0, prior[6, 6], 1.0))  # a fixed scale
    return Problem(
        source=source,
        surface=surface,
        T_world_coarse=start.T_world_coarse,
        depth_noise=config.noise * uncertainty.depth,
        units=units,
        prior=prior,
        weight=uncertainty.num_effective / jnp.maximum(jnp.sum(source.valid), 1),
    )


def pose_of(y: Float[Array, "7"], problem: Problem) -> tuple[jaxlie.SE3, Float[Array, ""]]:
    """Compute T_world_coarse exp(xi) and the scale from the unknowns y."""
    step = problem.units * y
    return problem.T_world_coarse @ jaxlie.SE3.exp(step[:6]), jnp.exp(step[6])


def candidates_at(y: Float[Array, "7"], problem: Problem, config: IcpConfig) -> Candidates:
    """Look up the Gaussians near every point at the pose of y."""
    T, scale = pose_of(y, problem)
    surface, points = problem.surface, transform(T, problem.source, scale).points
    return nearest(points, problem.source.valid, surface.gaussians.means, surface.groups, config.num_neighbours)


def matches_at(y: Float[Array, "7"], candidates: Candidates, problem: Problem, config: IcpConfig) -> Matches:
    """Match every point to a Gaussian at the pose of y."""
    T, scale = pose_of(y, problem)
    rays = problem.depth_noise[:, None] * problem.source.points
    placed, noise = transform(T, problem.source, scale), rays @ T.rotation().as_matrix().T
    return match(placed, noise, candidates, problem.surface, (config.max_mahalanobis_sq, config.min_normal_cos))


def distances(
    y: Float[Array, "7"], matches: Matches, problem: Problem, config: IcpConfig
) -> tuple[Float[Array, "p"], Bool[Array, "p"]]:
    """Measure each point's distance to its Gaussian's plane, as a fraction of its depth, and which pairs agree."""
    T, scale = pose_of(y, problem)
    placed = transform(T, problem.source, scale)
    depth = jnp.where(placed.valid, scale * problem.source.points[:, 2], 1.0)
    distance = jnp.sum((placed.points - matches.means) * matches.normals, axis=-1) / depth
    return distance, placed.valid & (jnp.abs(distance) <= config.max_misfit)


def residuals(
    y: Float[Array, "7"], args: tuple[Candidates, Problem, IcpConfig]
) -> tuple[Float[Array, "p 5"], Float[Array, "7"]]:
    """Compute the rows of every point and of the prior, in standard deviations.

    The matches carry no gradient. The derivative is computed here, once, and the solver gets rows that are linear in y;
    otherwise each of its uses of the derivative would be compiled and computed again. So the derivatives of a solution
    are those of Gauss-Newton, too: they neglect the residuals times the derivatives of their Jacobian, and are right if
    points fit their Gaussians.
    """
    candidates, problem, config = args
    fixed = jax.lax.stop_gradient(y)
    matches = jax.lax.stop_gradient(matches_at(fixed, candidates, problem, config))
    jacobian = jax.lax.stop_gradient(jax.jacfwd(rows_of)(fixed, matches, problem, config))
    rows = rows_of(fixed, matches, problem, config) + jacobian @ (y - fixed)
    return rows, problem.prior @ y


def rows_of(y: Float[Array, "7"], matches: Matches, problem: Problem, config: IcpConfig) -> Float[Array, "p 5"]:
    """Compute every point's rows for given matches: plane or ray, colour, whitened offset; in standard deviations."""
    T, scale = pose_of(y, problem)
    placed = transform(T, problem.source, scale)
    offset = placed.points - matches.means
    distance = jnp.sum(offset * matches.normals, axis=-1)
    plane, ray = distance / matches.plane_std, _along_ray(distance, T, matches, problem)
    light = matches.light + jnp.sum(matches.gradients * offset, axis=-1)
    shade = (light - intensity(placed.colors)) / config.color_std
    # The noise grows with the prediction's scale; otherwise shrinking all noisy points would fit best.
    noise = scale * matches.noise
    triangle, noise, entries = (jnp.unstack(rows, axis=-1) for rows in (matches.triangle, noise, offset))
    white = jnp.stack(widen(whiten(triangle, entries), noise), axis=-1)
    # A point beyond the gate has the constant cost of one at the gate, and no gradient.
    edge = jnp.sqrt(config.max_mahalanobis_sq)
    is_inlier = matches.is_inlier[:, None]
    has_plane, has_ray = config.residual == COLORED, config.residual == COLORED_RAY
    across = jnp.where(has_ray, jnp.clip(ray, -edge, edge), plane)
    rows = jnp.concatenate(
        [
            (has_plane | has_ray) * jnp.where(is_inlier, across[:, None], edge),
            (config.residual != DISTRIBUTION) * jnp.where(is_inlier, jnp.clip(shade, -edge, edge)[:, None], edge),
            ~(has_plane | has_ray) * jnp.where(is_inlier, white, edge / jnp.sqrt(3.0)),
        ],
        axis=-1,
    )
    valid = placed.valid
    return jnp.sqrt(problem.weight) * jnp.where(valid[:, None], rows, 0.0)


def _along_ray(distance: Float[Array, "p"], T: jaxlie.SE3, matches: Matches, problem: Problem) -> Float[Array, "p"]:
    """Compute the log-ratio of a point's depth to that of its Gaussian's plane along the ray, in standard deviations.

    A prediction is wrong by a factor along the ray; this is the factor's logarithm. Its derivatives by scale and
    rotation depend only on the ray's direction. Those of `distance` depend on the point itself, and so on the very
    error that they are multiplied by, which on average shrinks a frame by the square of its depth noise (errors in
    variables).
    """
    depth = jnp.sum((matches.means - T.translation()) * matches.normals, axis=-1)  # of the plane, along its normal
    least = jnp.maximum(LEAST_PLANE * problem.source.points[:, 2], jnp.finfo(depth.dtype).tiny)
    depth = jnp.where(jnp.abs(depth) > least, depth, least)
    std = jnp.sqrt(problem.depth_noise**2 + matches.plane_vars / depth**2)
    return jnp.log(jnp.maximum(1.0 + distance / depth, LEAST_RATIO)) / std


def information_of_rows(
    y: Float[Array, "7"], matches: Matches, problem: Problem, config: IcpConfig
) -> Float[Array, "7 7"]:
    """Compute J'J of the points' rows by (xi, log s) at y; 0 for a fixed scale."""
    units = problem.units
    jacobian = jax.jacfwd(rows_of)(y, matches, problem, config).reshape(-1, 7)
    jacobian = jnp.where(units > 0, jacobian / jnp.where(units > 0, units, 1.0), 0.0)
    return jacobian.T @ jacobian


def information_of_surface(
    T: jaxlie.SE3, scale: Float[Array, ""], matches: Matches, problem: Problem, config: IcpConfig
) -> Float[Array, "6 6"]:
    """Compute the inliers' information about xi by planes and colours: w Σ j j' with j = (a, x × a) / std.

    w is the weight of a point, a the normal or the gradient of the intensity, and x the point, both in the camera's
    axes. Offsets from means do not count: the mean of a Gaussian is no landmark on its surface.
    """
    points, to_camera = scale * problem.source.points, T.rotation().as_matrix()
    normals, gradients = matches.normals @ to_camera, matches.gradients @ to_camera
    has_color = config.residual != DISTRIBUTION
    axes = jnp.concatenate([normals / matches.plane_std[:, None], has_color * gradients / config.color_std])
    rows = jnp.concatenate([axes, jnp.cross(jnp.concatenate([points, points]), axes)], axis=-1)
    rows = jnp.where(jnp.concatenate([matches.is_inlier] * 2)[:, None], rows, 0.0)
    return problem.weight * rows.T @ rows


def least_information(points: Float[Array, "6 6"], problem: Problem) -> Float[Array, ""]:
    """Compute the smallest eigenvalue of the information about the pose, in units of the unknowns.

    Args:
        points: their information about xi; that of the prior is added.
    """
    units, prior = problem.units[:6], problem.prior[:, :6]
    return jnp.maximum(jnp.linalg.eigvalsh(units[:, None] * points * units + prior.T @ prior)[0], 0.0)
