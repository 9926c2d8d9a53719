"""Bundle adjustment of a window: Levenberg–Marquardt over the poses, every point eliminated.

For given poses each point has its own small least-squares problem. Its Gauss–Newton solution, as a function of the
poses, leaves a problem in the poses alone (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 1973), whose
Jacobian is that of the Schur complement.

The lens may be an unknown too. Baselines are short, so a radial error of the pixels does not show as a large residual:
it turns the views and moves them the other way, and structure and path get two scales (7-Scenes: k = -.03, 6 %).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, project
from emgs_jax.ops.linalg import inverse_3x3
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced
from emgs_jax.prior.multiview.lens import undistort


class BundleConfig(eqx.Module):
    """The robust loss and the solve.

    Args:
        pixel_std: standard deviation of a detected point; larger errors count ever less (Cauchy).
        damping: of a point's solve, as a fraction of its Hessian's trace: holds the depth of a point without parallax.
        num_point_steps: Gauss–Newton steps of every point for given poses.
        max_steps: of the solver.
        tolerance: relative and absolute, of the solver.
    """

    pixel_std: Float[Array, "*b"] = traced(low=1e-6, high=1000)
    damping: Float[Array, "*b"] = traced(low=0, high=1)
    num_point_steps: int = static(low=0, high=100)
    max_steps: int = static(low=0, high=1000)
    tolerance: float = static(low=0, high=1)


class Tracks(eqx.Module):
    """Where landmarks were seen.

    Args:
        pixels: (x, y) of landmark l in view v.
        is_seen: False where the view does not see the landmark.
    """

    pixels: Float[Array, "v l 2"]
    is_seen: Bool[Array, "v l"]


class Unknowns(eqx.Module):
    """What is solved for, beside the points.

    Args:
        is_fixed: views whose pose is held.
        distortion_std: what the lens's distortion is expected to be, see `undistort`; 0 = it has none.
    """

    is_fixed: Bool[Array, "v"]
    distortion_std: Float[Array, ""]


def _errors(
    T_ref_view: jaxlie.SE3, points: Float[Array, "l 3"], tracks: Tracks, camera: Camera
) -> tuple[Float[Array, "v l 2"], Float[Array, "v l 2 3"], Bool[Array, "v l"]]:
    """Reprojection errors (px), their Jacobians by the point, and which of them count."""
    rotation = T_ref_view.rotation().as_matrix()
    local = jnp.einsum("vij,vli->vlj", rotation, points - T_ref_view.translation()[:, None])
    pixels, depth = project(camera, local)
    seen = tracks.is_seen & (depth > NEAREST_DEPTH)
    safe_depth = jnp.where(seen, depth, 1.0)
    along = jnp.eye(2, 3) - local[..., :2, None] * jnp.array([0.0, 0.0, 1.0]) / safe_depth[..., None, None]
    by_local = camera.focal[:, None] * along / safe_depth[..., None, None]
    jacobian = jnp.einsum("vlij,vkj->vlik", by_local, rotation)
    return jnp.where(seen[..., None], pixels - tracks.pixels, 0.0), jacobian, seen


def _moved(
    T_ref_view: jaxlie.SE3, points: Float[Array, "l 3"], tracks: Tracks, camera: Camera, config: BundleConfig
) -> Float[Array, "l 3"]:
    """One Gauss–Newton step of every point; differentiable in the poses as the Schur complement is."""
    errors, jacobian, seen = _errors(T_ref_view, points, tracks, camera)
    fixed, jacobian = jax.lax.stop_gradient((errors, jacobian))
    weight = seen / (1.0 + jnp.sum(fixed**2, axis=-1) / config.pixel_std**2)
    weighted = weight[..., None, None] * jacobian
    hessian = jnp.einsum("vlij,vlik->ljk", weighted, jacobian)
    trace = jnp.trace(hessian, axis1=-2, axis2=-1)
    inverse = inverse_3x3(hessian + (config.damping * trace)[:, None, None] * jnp.eye(3))
    step = jnp.einsum("ljk,vlik,vli->lj", inverse, weighted, errors)
    return points - jnp.where(trace[:, None] > 0, step, 0.0)


def settle(
    T_ref_view: jaxlie.SE3, points: Float[Array, "l 3"], tracks: Tracks, camera: Camera, config: BundleConfig
) -> Float[Array, "l 3"]:
    """The points that fit these poses, by `num_point_steps` Gauss–Newton steps."""
    still = jax.lax.stop_gradient(T_ref_view.wxyz_xyz)
    for _ in range(config.num_point_steps - 1):
        points = jax.lax.stop_gradient(_moved(jaxlie.SE3(still), points, tracks, camera, config))
    return _moved(T_ref_view, points, tracks, camera, config)


def _posed(xi: Float[Array, "v 6"], T_ref_view: jaxlie.SE3, is_fixed: Bool[Array, "v"]) -> jaxlie.SE3:
    return T_ref_view @ jaxlie.SE3.exp(jnp.where(is_fixed[:, None], 0.0, xi))


def _seen_by(lens: Float[Array, ""], tracks: Tracks, unknowns: Unknowns, camera: Camera) -> Tracks:
    distortion, pixels = unknowns.distortion_std * lens, jnp.where(tracks.is_seen[..., None], tracks.pixels, 0.0)
    return Tracks(undistort(pixels, distortion, camera.focal, camera.center), tracks.is_seen)


def _residuals(unknown: tuple, args: tuple) -> tuple[Float[Array, "v l 2"], Float[Array, ""]]:
    """Reprojection errors in standard deviations, whose squares sum to the Cauchy loss, and the distortion in its."""
    (xi, lens), (T_start, points, tracks, unknowns, camera, config) = unknown, args
    T, tracks = _posed(xi, T_start, unknowns.is_fixed), _seen_by(lens, tracks, unknowns, camera)
    points = settle(T, points, tracks, camera, config)
    errors, _, seen = _errors(T, points, tracks, camera)
    errors = errors / config.pixel_std
    squared = jnp.where(seen, jnp.sum(errors**2, axis=-1), 1.0)
    safe = jnp.maximum(squared, 1e-6)
    return jnp.where(seen, jnp.sqrt(jnp.log1p(safe) / safe), 0.0)[..., None] * errors, lens


@full_precision
def adjust(
    T_ref_view: jaxlie.SE3,
    points: Float[Array, "l 3"],
    tracks: Tracks,
    unknowns: Unknowns,
    camera: Camera,
    config: BundleConfig,
) -> tuple[jaxlie.SE3, Float[Array, "l 3"], Float[Array, ""], Float[Array, "v l"]]:
    """Poses, points and lens that minimise the robust reprojection error.

    Args:
        T_ref_view: where to start; camera -> reference.
        points: likewise, reference frame.
        tracks: a landmark that no view sees stays where it is.
        unknowns: what is solved for.
        camera: of all views.
        config: loss and solve.

    Returns:
        Poses, points, the distortion, and the reprojection error (px) of every observation, inf where it is none or
        behind the view.
    """
    args = (T_ref_view, points, tracks, unknowns, camera, config)
    solver = optx.LevenbergMarquardt(
        rtol=config.tolerance, atol=config.tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    start = jnp.zeros((unknowns.is_fixed.shape[0], 6)), jnp.zeros(())
    solution = optx.least_squares(_residuals, solver, start, args, max_steps=config.max_steps, throw=False).value
    is_finite = jnp.all(jnp.isfinite(solution[0])) & jnp.isfinite(solution[1])
    xi, lens = (jnp.where(is_finite, found, 0.0) for found in solution)
    T, tracks = _posed(xi, T_ref_view, unknowns.is_fixed), _seen_by(lens, tracks, unknowns, camera)
    points = settle(T, points, tracks, camera, config)
    errors, _, seen = _errors(T, points, tracks, camera)
    error = jnp.where(seen, jnp.linalg.norm(errors, axis=-1), jnp.inf)
    return T, points, unknowns.distortion_std * lens, error
