"""ICP against Gaussians as one Levenberg–Marquardt solve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians
from emgs_jax.linalg import inverse_and_logdet, mahalanobis_sq, outer, tangent_basis
from emgs_jax.neighbours import knn
from emgs_jax.observation import Observation, transform
from emgs_jax.pytree import choice, static, take_rows, traced
from emgs_jax.rigid import median

LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601
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
        max_mahalanobis_sq: a point farther from all its neighbours than this is no inlier.
        min_normal_cos: nor one whose normal differs more from its Gaussian's.
        num_effective: how many independent measurements the points are worth: their errors are correlated.
        prior_information: of the coarse pose, in units of one effective point as noisy as the coarse step shows;
            0 = no prior, the printed form.
        num_points: how many points take part.
        num_neighbours: Gaussians that are compared for each point.
        num_color_neighbours: Gaussians from which a Gaussian's intensity gradient is fitted.
        max_steps: of the solver.
        tolerance: relative and absolute, of the solver.
    """

    residual: Float[Array, "*b"] = choice(*RESIDUALS)
    color_std: Float[Array, "*b"] = traced()
    noise: Float[Array, "*b"] = traced()
    max_mahalanobis_sq: Float[Array, "*b"] = traced()
    min_normal_cos: Float[Array, "*b"] = traced()
    num_effective: Float[Array, "*b"] = traced()
    prior_information: Float[Array, "*b"] = traced()
    num_points: int = static()
    num_neighbours: int = static()
    num_color_neighbours: int = static()
    max_steps: int = static()
    tolerance: float = static()


class IcpInfo(eqx.Module):
    """What the solve found.

    Args:
        num_inliers: points with a Gaussian that passes the gates.
        inlier_fraction: of the points that take part.
        residual: m; root mean square distance of the inliers to their Gaussians' planes.
        misfit: m; the same distance of all points, as 1.4826 times the median, a robust standard deviation.
        min_eigenvalue: smallest eigenvalue of the Hessian, prior included, per effective point (1/m² and 1/rad²).
        num_steps: of the solver.
        is_converged: False where the solver reached `max_steps` or failed.
    """

    num_inliers: Int[Array, ""]
    inlier_fraction: Float[Array, ""]
    residual: Float[Array, ""]
    misfit: Float[Array, ""]
    min_eigenvalue: Float[Array, ""]
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]


def intensity(colors: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Luminance of RGB."""
    return colors @ jnp.array(LUMINANCE, colors.dtype)


def color_gradients(gaussians: Gaussians, num_neighbours: int) -> Float[Array, "n 3"]:
    """Intensity gradient (1/m) of every Gaussian in its tangent plane, fitted to its neighbours; orthogonal to n."""
    rows, found = knn(gaussians.means, gaussians.means, gaussians.valid, num_neighbours)
    basis = tangent_basis(gaussians.normals)
    offsets = jnp.einsum("nkd,nda->nka", gaussians.means[rows] - gaussians.means[:, None], basis)
    offsets = jnp.where(found[..., None], offsets, 0.0)
    light = intensity(gaussians.colors)
    moments = jnp.einsum("nka,nkb->nab", offsets, offsets)
    cross = jnp.einsum("nka,nk->na", offsets, light[rows] - light[:, None])
    # A hundredth of the spread keeps the fit of collinear neighbours finite.
    ridge = 0.01 * jnp.trace(moments, axis1=-2, axis2=-1) + 1e-8
    slopes = jnp.linalg.solve(moments + ridge[:, None, None] * jnp.eye(2), cross[..., None])[..., 0]
    return jnp.einsum("nda,na->nd", basis, slopes)


class _Matches(eqx.Module):
    """The Gaussian of every point, held fixed while a step is linearised."""

    means: Float[Array, "p 3"]
    normals: Float[Array, "p 3"]
    whitening: Float[Array, "p 3 3"]
    plane_std: Float[Array, "p"]
    light: Float[Array, "p"]
    gradients: Float[Array, "p 3"]
    is_inlier: Bool[Array, "p"]


def _match(
    source: Observation, noise: Float[Array, "p 3"], target: Gaussians, gradients: Array, config: IcpConfig
) -> _Matches:
    """For each world point the nearest of its neighbouring Gaussians in Mahalanobis distance."""
    points = source.points
    rows, found = knn(points, target.means, target.valid, config.num_neighbours)
    covs = target.covs[rows] + outer(noise)[:, None]
    precisions, _ = inverse_and_logdet(covs)
    distance_sq = jnp.where(found, mahalanobis_sq(points[:, None] - target.means[rows], precisions), jnp.inf)
    best = jnp.argmin(distance_sq, axis=-1)[:, None]
    row = jnp.take_along_axis(rows, best, axis=1)[:, 0]
    near = take_rows(target, row)
    precision = jnp.take_along_axis(precisions, best[..., None, None], axis=1)[:, 0]
    cov = jnp.take_along_axis(covs, best[..., None, None], axis=1)[:, 0]
    cos = jnp.sum(near.normals * source.normals, axis=-1)
    is_near = jnp.take_along_axis(distance_sq, best, axis=1)[:, 0] <= config.max_mahalanobis_sq
    return _Matches(
        means=near.means,
        normals=near.normals,
        whitening=jnp.swapaxes(jnp.linalg.cholesky(precision), -1, -2),
        plane_std=jnp.sqrt(jnp.einsum("pi,pij,pj->p", near.normals, cov, near.normals) + 1e-12),
        light=intensity(near.colors),
        gradients=gradients[row],
        is_inlier=source.valid & is_near & (cos >= config.min_normal_cos),
    )


class _Problem(eqx.Module):
    """What stays the same while the pose moves; lengths in metres."""

    source: Observation  # camera frame
    rays: Float[Array, "p 3"]  # noise of every point along its viewing ray, camera frame
    target: Gaussians
    gradients: Float[Array, "n 3"]
    T_world_coarse: jaxlie.SE3
    prior: Float[Array, "6"]  # 1 / standard deviation of xi


def _pose_problem(
    source: Observation,
    target: Gaussians,
    T_world_coarse: jaxlie.SE3,
    noise: tuple[Float[Array, ""], Float[Array, ""]],
    config: IcpConfig,
) -> _Problem:
    pose_noise, depth_noise = noise
    stride = max(source.valid.shape[0] // config.num_points, 1)
    source = jax.tree.map(lambda leaf: leaf[::stride], source)
    # Only where colour counts: the gradients cost a neighbour search over the submap.
    gradients = jax.lax.cond(
        config.residual != DISTRIBUTION,
        lambda: color_gradients(target, config.num_color_neighbours),
        lambda: jnp.zeros_like(target.means),
    )
    prior = jnp.sqrt(config.prior_information) / jnp.repeat(jnp.stack([pose_noise, depth_noise]), 3)
    rays = config.noise * depth_noise * source.points
    return _Problem(source, rays, target, gradients, T_world_coarse, prior)


def _place(xi: Float[Array, "6"], problem: _Problem, config: IcpConfig) -> tuple[Observation, _Matches]:
    """The source in the world frame at T_world_coarse exp(xi), and its matches, which carry no gradient."""
    T = problem.T_world_coarse @ jaxlie.SE3.exp(xi)
    placed = transform(T, problem.source, jnp.ones(()))
    noise = problem.rays @ T.rotation().as_matrix().T
    fixed, noise = jax.lax.stop_gradient((placed, noise))
    return placed, jax.lax.stop_gradient(_match(fixed, noise, problem.target, problem.gradients, config))


def _residuals(
    xi: Float[Array, "6"], args: tuple[_Problem, IcpConfig]
) -> tuple[Float[Array, "p 5"], Float[Array, "6"]]:
    """Rows of every point (plane, colour, whitened offset) and of the prior, in standard deviations."""
    problem, config = args
    placed, match = _place(xi, problem, config)
    offset = placed.points - match.means
    plane = jnp.sum(offset * match.normals, axis=-1) / match.plane_std
    light = match.light + jnp.sum(match.gradients * offset, axis=-1)
    shade = (light - intensity(placed.colors)) / config.color_std
    white = jnp.einsum("pij,pj->pi", match.whitening, offset)
    # A point beyond the gate costs what it would at the gate and pulls nowhere.
    edge = jnp.sqrt(config.max_mahalanobis_sq)
    is_inlier = match.is_inlier[:, None]
    rows = jnp.concatenate(
        [
            (config.residual == COLORED) * jnp.where(is_inlier, plane[:, None], edge),
            (config.residual != DISTRIBUTION) * jnp.where(is_inlier, jnp.clip(shade, -edge, edge)[:, None], edge),
            (config.residual != COLORED) * jnp.where(is_inlier, white, edge / jnp.sqrt(3.0)),
        ],
        axis=-1,
    )
    valid = placed.valid
    share = jnp.sqrt(config.num_effective / jnp.maximum(jnp.sum(valid), 1))
    return share * jnp.where(valid[:, None], rows, 0.0), problem.prior * xi


def icp(
    source: Observation,
    target: Gaussians,
    T_world_coarse: jaxlie.SE3,
    noise: tuple[Float[Array, ""], Float[Array, ""]],
    config: IcpConfig,
) -> tuple[jaxlie.SE3, IcpInfo]:
    """Place camera-frame `source` on `target`: argmin over xi of data + prior, T = T_world_coarse exp(xi).

    The data term is a truncated least-squares sum over the points, scaled so that all of them together weigh as much
    as `num_effective` independent ones. The prior holds xi at 0 with `prior_information`.

    Args:
        source: points to align, camera frame.
        target: Gaussians of the submap, world frame.
        T_world_coarse: where to start, and the mean of the prior.
        noise: standard deviation of the coarse pose in metres, and of the points' depth as a fraction of it.
        config: terms and gates.
    """
    problem = _pose_problem(source, target, T_world_coarse, noise, config)
    solver = optx.LevenbergMarquardt(rtol=config.tolerance, atol=config.tolerance)
    start, args = jnp.zeros(6), (problem, config)
    solution = optx.least_squares(_residuals, solver, start, args, max_steps=config.max_steps, throw=False)
    xi = jnp.where(jnp.all(jnp.isfinite(solution.value)), solution.value, start)

    placed, match = _place(xi, problem, config)
    num_inliers = jnp.sum(match.is_inlier)
    distance = jnp.sum((placed.points - match.means) * match.normals, axis=-1)
    jacobian = jnp.concatenate([rows.reshape(-1, 6) for rows in jax.jacfwd(_residuals)(xi, args)])
    hessian = jacobian.T @ jacobian / jnp.maximum(config.num_effective, 1.0)
    info = IcpInfo(
        num_inliers=num_inliers,
        inlier_fraction=num_inliers / jnp.maximum(jnp.sum(placed.valid), 1),
        residual=jnp.sqrt(jnp.sum(jnp.where(match.is_inlier, distance, 0.0) ** 2) / jnp.maximum(num_inliers, 1)),
        misfit=1.4826 * median(jnp.abs(distance), placed.valid),
        min_eigenvalue=jnp.linalg.eigvalsh(hessian)[0],
        num_steps=solution.stats["num_steps"],
        is_converged=solution.result == optx.RESULTS.successful,
    )
    return T_world_coarse @ jaxlie.SE3.exp(xi), info
