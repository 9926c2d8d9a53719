"""Cost function of ICP: the distances of points from Gaussians, in standard deviations, and the prior of the pose."""

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
LEAST_PLANE = 1e-6  # distance of a plane from the camera, of that of the point before it
LEAST_RATIO = 1e-3  # of a point's depth over that of a plane; less is behind the camera


class IcpConfig(eqx.Module):
    """Terms, gates and limits of the solve (R9).

    Args:
        residual: `colored` (printed): distance to the Gaussian's plane and intensity difference (Park et al.,
            "Colored point cloud registration revisited", ICCV 2017); `distribution`: offset from the mean, whitened by
            the Gaussian's covariance; `colored+distribution`: offset and intensity difference; or `colored+ray`: depth
            along the viewing ray over that of the Gaussian's plane, and intensity difference.
        noise: factor on the points' noise along their viewing rays, which widens every Gaussian for them.
        max_misfit: fraction of the depth; a point farther from its Gaussian's plane shows something else, and says
            nothing of the noise; 0 takes the noise as it is given.
        max_mahalanobis_sq: a point farther from all its neighbours than this is no inlier.
        min_normal_cos: nor one whose normal differs more from its Gaussian's.
        prior_information: of the coarse pose, in units of one effective point as noisy as the coarse step shows;
            0 = no prior, the printed form.
        scale_noise: standard deviation of the logarithm of the scale about the coarse step's, in units of the points'
            depth noise, where nothing else is known of it; 0 = no scale (printed).
        max_field: of a logarithm of depth; what differs more from the map is another surface, and says nothing of the
            field of a frame's depth errors; 0: none is sought (printed).
        field_length: over which these errors are alike, as a fraction of the image's side.
        num_points: how many points take part at least: every n-th of them, with the largest n that leaves so many.
        num_searches: how often the Gaussians near every point are looked up, each time with a solve after it.
        num_neighbours: Gaussians near a point, which every step of a solve compares.
        num_color_neighbours: Gaussians from which a Gaussian's intensity gradient is fitted.
        tolerance: relative and absolute, of the solver; float32 tells no smaller differences apart than the least.
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
    """Start of ICP, and how much of that is known before it looks at the points.

    Args:
        T_world_coarse: also the mean of the pose.
        root_information: root of the information of (xi, log s) where the points fit as well as they should.
        noise: least standard deviation of the points' depth, as a fraction of it.
        is_given: the prior itself says how sure it is of the pose, see `pose_worth`.
    """

    T_world_coarse: jaxlie.SE3
    root_information: Float[Array, "7 7"]
    noise: Float[Array, ""]
    is_given: Bool[Array, ""]


class Problem(eqx.Module):
    """Constants of the ICP problem while the pose moves; lengths in metres, unknowns in units of their own."""

    source: Observation  # camera frame
    surface: Surface
    T_world_coarse: jaxlie.SE3
    depth_noise: Float[Array, "p"]  # of every point along its viewing ray, as a fraction
    units: Float[Array, "7"]  # of (xi, log s) for one of the unknowns; 0 for a scale that stays
    prior: Float[Array, "7 7"]  # root of the information of the coarse pose and scale, by the unknowns
    weight: Float[Array, ""]  # of a point


def pose_worth(is_given: Bool[Array, ""], misfit: Float[Array, ""], depth_noise: Float[Array, ""]) -> Float[Array, "7"]:
    """Return the factors on the standard deviations of a coarse pose and scale whose points do not fit as they should.

    Of a pose that comes with its uncertainty the points' misfit says nothing.

    Args:
        is_given: the prior itself says how sure it is of the pose.
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

    Translation counts in the median depth, so that the solver's damping and tolerance mean the same in every unit of
    length, and the seventh unknown in the depth noise.
    """
    depth = median(source.points[:, 2], source.valid)
    units = jnp.ones(7).at[:3].set(depth).at[6].set(config.scale_noise * start.noise)
    worth = pose_worth(start.is_given, uncertainty.common, start.noise)
    prior = (config.prior_information > 0) * start.root_information * units / worth
    prior = prior.at[6, 6].set(jnp.where(units[6] * prior[6, 6] > 0, prior[6, 6], 1.0))  # a scale that stays
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
    """T_world_coarse exp(xi), and the scale, for the unknowns y."""
    step = problem.units * y
    return problem.T_world_coarse @ jaxlie.SE3.exp(step[:6]), jnp.exp(step[6])


def candidates_at(y: Float[Array, "7"], problem: Problem, config: IcpConfig) -> Candidates:
    """The Gaussians near every point, placed by the unknowns y."""
    T, scale = pose_of(y, problem)
    surface, points = problem.surface, transform(T, problem.source, scale).points
    return nearest(points, problem.source.valid, surface.gaussians.means, surface.groups, config.num_neighbours)


def matches_at(y: Float[Array, "7"], candidates: Candidates, problem: Problem, config: IcpConfig) -> Matches:
    """The Gaussian of every point at y."""
    T, scale = pose_of(y, problem)
    rays = problem.depth_noise[:, None] * problem.source.points
    placed, noise = transform(T, problem.source, scale), rays @ T.rotation().as_matrix().T
    return match(placed, noise, candidates, problem.surface, (config.max_mahalanobis_sq, config.min_normal_cos))


def distances(
    y: Float[Array, "7"], matches: Matches, problem: Problem, config: IcpConfig
) -> tuple[Float[Array, "p"], Bool[Array, "p"]]:
    """Of every point to the plane of its Gaussian, as a fraction of its depth, and which show the same surface."""
    T, scale = pose_of(y, problem)
    placed = transform(T, problem.source, scale)
    depth = jnp.where(placed.valid, scale * problem.source.points[:, 2], 1.0)
    distance = jnp.sum((placed.points - matches.means) * matches.normals, axis=-1) / depth
    return distance, placed.valid & (jnp.abs(distance) <= config.max_misfit)


def residuals(
    y: Float[Array, "7"], args: tuple[Candidates, Problem, IcpConfig]
) -> tuple[Float[Array, "p 5"], Float[Array, "7"]]:
    """Rows of every point and of the prior, in standard deviations.

    The matches carry no gradient. The derivative is made here, once, and the solver gets rows that are linear in y:
    otherwise each of its uses of the derivative would be compiled, and computed, anew. So the derivatives of a solution
    are Gauss-Newton's as well: they leave out the residuals times the derivatives of their Jacobian, and are right
    where points fit their Gaussians.
    """
    candidates, problem, config = args
    fixed = jax.lax.stop_gradient(y)
    matches = jax.lax.stop_gradient(matches_at(fixed, candidates, problem, config))
    jacobian = jax.lax.stop_gradient(jax.jacfwd(rows_of)(fixed, matches, problem, config))
    rows = rows_of(fixed, matches, problem, config) + jacobian @ (y - fixed)
    return rows, problem.prior @ y


def rows_of(y: Float[Array, "7"], matches: Matches, problem: Problem, config: IcpConfig) -> Float[Array, "p 5"]:
    """Plane or ray, colour and whitened offset of every point for given matches, in standard deviations."""
    T, scale = pose_of(y, problem)
    placed = transform(T, problem.source, scale)
    offset = placed.points - matches.means
    distance = jnp.sum(offset * matches.normals, axis=-1)
    plane, ray = distance / matches.plane_std, _along_ray(distance, T, matches, problem)
    light = matches.light + jnp.sum(matches.gradients * offset, axis=-1)
    shade = (light - intensity(placed.colors)) / config.color_std
    # The noise is the prediction's and grows with its scale; else a scale that shrinks all noisy points fits best.
    noise = scale * matches.noise
    triangle, noise, entries = (jnp.unstack(rows, axis=-1) for rows in (matches.triangle, noise, offset))
    white = jnp.stack(widen(whiten(triangle, entries), noise), axis=-1)
    # A point beyond the gate costs what it would at the gate and pulls nowhere.
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
    """log of a point's depth over that at which its ray meets its Gaussian's plane, in standard deviations.

    A prediction errs by a factor along the ray, and this is that factor's logarithm. Its derivatives by scale and
    rotation have only the ray's direction in them. Those of `distance` have the point itself, and with it the very
    error that they are multiplied by: in the mean that shrinks a frame by the square of its depth noise (errors in
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
    """J'J of the points' rows by (xi, log s) about y; 0 for the scale where it is no unknown."""
    units = problem.units
    jacobian = jax.jacfwd(rows_of)(y, matches, problem, config).reshape(-1, 7)
    jacobian = jnp.where(units > 0, jacobian / jnp.where(units > 0, units, 1.0), 0.0)
    return jacobian.T @ jacobian


def information_of_surface(
    T: jaxlie.SE3, scale: Float[Array, ""], matches: Matches, problem: Problem, config: IcpConfig
) -> Float[Array, "6 6"]:
    """Compute the inliers' information about xi by planes and colours: w Σ j j' with j = (a, x × a) / std.

    w is the weight of a point, a is the normal, or the gradient of the intensity, and x the point, both in the camera's
    axes. Offsets from means do not count: the mean of a Gaussian is no landmark of its surface.
    """
    points, to_camera = scale * problem.source.points, T.rotation().as_matrix()
    normals, gradients = matches.normals @ to_camera, matches.gradients @ to_camera
    has_color = config.residual != DISTRIBUTION
    axes = jnp.concatenate([normals / matches.plane_std[:, None], has_color * gradients / config.color_std])
    rows = jnp.concatenate([axes, jnp.cross(jnp.concatenate([points, points]), axes)], axis=-1)
    rows = jnp.where(jnp.concatenate([matches.is_inlier] * 2)[:, None], rows, 0.0)
    return problem.weight * rows.T @ rows


def least_information(points: Float[Array, "6 6"], problem: Problem) -> Float[Array, ""]:
    """Smallest eigenvalue of the information about the pose, in the units of the unknowns.

    Args:
        points: their information about xi, to which that of the prior is added.
    """
    units, prior = problem.units[:6], problem.prior[:, :6]
    return jnp.maximum(jnp.linalg.eigvalsh(units[:, None] * points * units + prior.T @ prior)[0], 0.0)
