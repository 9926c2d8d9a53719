"""Bundle adjustment of a window: Levenberg–Marquardt over poses, points and lens, every point eliminated.

Landmarks meet in the poses only, so each has its own three normal equations. What they leave is the Schur complement, a
small dense problem in the poses (Triggs et al., "Bundle adjustment: a modern synthesis", 2000). An error e counts by
the Cauchy loss log(1 + e²/σ²)/2, which gives it the weight 1 / (σ² + e²).

The lens may be an unknown too. Baselines are short, so a radial error of the pixels does not show as a large residual:
it turns the views and moves them the other way, and structure and path get two scales (7-Scenes: k = .03, 6 %).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, project
from emgs_jax.ops.linalg import inverse_3x3
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced
from emgs_jax.prior.multiview.lens import undistort

FIRST_DAMPING, LEAST_DAMPING, DAMPING_FACTOR = 1e-4, 1e-8, 10.0  # Marquardt's, as a fraction of the diagonal


class BundleConfig(eqx.Module):
    """The robust loss and the solve.

    Args:
        pixel_std: σ, standard deviation of a detected point.
        damping: of a point's solve, as a fraction of its Hessian's trace: holds the depth of a point without parallax.
        max_steps: of the solver.
        tolerance: it ends with a step that lowers the loss by less than this fraction.
    """

    pixel_std: Float[Array, "*b"] = traced(low=1e-6, high=1000)
    damping: Float[Array, "*b"] = traced(low=0, high=1)
    max_steps: int = static(low=0, high=1000)
    tolerance: float = static(low=0, high=1)


class Tracks(eqx.Module):
    """Observations of landmarks in views.

    Args:
        pixels: (x, y) of landmark l in view v.
        is_seen: False where the view does not see the landmark.
    """

    pixels: Float[Array, "v l 2"]
    is_seen: Bool[Array, "v l"]


class Unknowns(eqx.Module):
    """Unknowns of the bundle adjustment, beside the points.

    Args:
        free: rows of the views whose pose is not fixed; v where there are fewer.
        distortion: of the lens, initial value, see `undistort`.
        distortion_std: standard deviation of its prior; 0 = the tracks are of a pinhole camera.
    """

    free: Int[Array, "f"]
    distortion: Float[Array, ""]
    distortion_std: Float[Array, ""]


class Estimate(NamedTuple):
    """Poses, camera -> reference; points of the reference frame; the distortion in its standard deviations."""

    T_ref_view: jaxlie.SE3
    points: Float[Array, "l 3"]
    lens: Float[Array, ""]


class Problem(NamedTuple):
    """Problem of the bundle adjustment: observations, unknowns, camera and settings."""

    tracks: Tracks
    unknowns: Unknowns
    camera: Camera
    config: BundleConfig


def _moved(
    estimate: Estimate, xi: Float[Array, "*v 6"], points_step: Float[Array, "*l 3"], lens_step: Float[Array, ""]
) -> Estimate:
    """Poses T Exp(ξ), points and lens after a step; a single row is one of all."""
    moved = estimate.T_ref_view @ jaxlie.SE3.exp(xi)
    return Estimate(moved, estimate.points + points_step, estimate.lens + lens_step)


def _errors(estimate: Estimate, problem: Problem) -> tuple[Float[Array, "v l 2"], Bool[Array, "v l"]]:
    """Reprojection errors (px), and which of them count: what is seen and in front of the view. The others are 0."""
    T, tracks, camera = estimate.T_ref_view, problem.tracks, problem.camera
    away = estimate.points - T.translation()[:, None]
    pixels, depth = project(camera, jnp.einsum("vij,vli->vlj", T.rotation().as_matrix(), away))
    shown = jnp.where(tracks.is_seen[..., None], tracks.pixels, 0.0)
    distortion = problem.unknowns.distortion_std * estimate.lens
    counts = tracks.is_seen & (depth > NEAREST_DEPTH)
    errors = pixels - undistort(shown, distortion, camera.focal, camera.center)
    return jnp.where(counts[..., None], errors, 0.0), counts


def _loss(estimate: Estimate, problem: Problem) -> Float[Array, ""]:
    """The sum of the losses; what is behind its view counts as an error of a focal length."""
    errors, counts = _errors(estimate, problem)
    behind = problem.tracks.is_seen & ~counts
    squares = jnp.where(behind, jnp.sum(problem.camera.focal**2), jnp.sum(errors**2, axis=-1))
    return 0.5 * (jnp.sum(jnp.log1p(squares / problem.config.pixel_std**2)) + estimate.lens**2)


def _columns(unknowns: Unknowns, num_views: int) -> Float[Array, "v 7 u"]:
    """Map each view's ξ, and the lens as the last row, to columns of the unknowns; rows of a fixed pose are 0."""
    of_view = (unknowns.free == jnp.arange(num_views)[:, None]).astype(jnp.float32)
    of_poses = jnp.einsum("vf,ab->vafb", of_view, jnp.eye(6)).reshape(num_views, 6, -1)
    return jnp.pad(of_poses, ((0, 0), (0, 1), (0, 1))).at[:, -1, -1].set(1.0)


def _step(
    estimate: Estimate, problem: Problem, damping: Float[Array, ""]
) -> tuple[Float[Array, "v 6"], Float[Array, "l 3"], Float[Array, ""]]:
    """Of poses, points and lens, by the damped normal equations of the weighted errors."""
    (errors, counts), config = _errors(estimate, problem), problem.config
    # A step that all views, or all points, share moves each error as one of its own does.
    shared = jax.jacfwd(lambda x: _errors(_moved(estimate, x[:6], x[7:], x[6]), problem)[0])(jnp.zeros(10))
    root = jnp.sqrt(counts / (config.pixel_std**2 + jnp.sum(errors**2, axis=-1)))[..., None]
    J, errors = root[..., None] * shared, root * errors
    J, of_points = J[..., :7], J[..., 7:]
    columns = _columns(problem.unknowns, len(J))
    A = jnp.einsum("vac,vlia,vlib,vbd->cd", columns, J, J, columns).at[-1, -1].add(1.0)
    B = jnp.einsum("vac,vlaj->lcj", columns, jnp.einsum("vlia,vlij->vlaj", J, of_points))
    C = jnp.einsum("vlij,vlik->ljk", of_points, of_points)
    a = -jnp.einsum("vac,vlia,vli->c", columns, J, errors).at[-1].add(estimate.lens)
    c = -jnp.einsum("vlij,vli->lj", of_points, errors)
    A = A + jnp.diag(jnp.where(jnp.diagonal(A) > 0, damping * jnp.diagonal(A), 1.0))
    trace = jnp.trace(C, axis1=-2, axis2=-1)[:, None, None]
    inverse = inverse_3x3(C + ((config.damping + damping) * trace + (trace == 0)) * jnp.eye(3))
    onto = jnp.einsum("lcj,ljk->lck", B, inverse)
    std = jnp.sqrt(jnp.diagonal(A))  # scaled so, the equations of metres and radians are alike
    schur = (A - jnp.einsum("lcj,ldj->cd", onto, B)) / std / std[:, None]
    step = cho_solve(cho_factor(schur, lower=True), (a - jnp.einsum("lcj,lj->c", onto, c)) / std) / std
    points = jnp.einsum("ljk,lk->lj", inverse, c - jnp.einsum("lcj,c->lj", B, step))
    return jnp.einsum("vac,c->va", columns[:, :6], step), points, step[-1]


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
    problem = Problem(tracks, unknowns, camera, config)

    def is_going_on(state: tuple) -> Bool[Array, ""]:
        *_, count, is_done = state
        return (count < config.max_steps) & ~is_done

    def body(state: tuple) -> tuple:
        estimate, loss, damping, count, _ = state
        found = _moved(estimate, *_step(estimate, problem, damping))
        new = _loss(found, problem)
        is_better = new < loss  # never where a step is not finite
        estimate = jax.tree.map(lambda a, b: jnp.where(is_better, a, b), found, estimate)
        damping = jnp.where(is_better, jnp.maximum(damping / DAMPING_FACTOR, LEAST_DAMPING), damping * DAMPING_FACTOR)
        is_done = is_better & (loss - new <= config.tolerance * loss)
        return estimate, jnp.where(is_better, new, loss), damping, count + 1, is_done

    std = unknowns.distortion_std
    start = Estimate(T_ref_view, points, jnp.where(std > 0, unknowns.distortion / jnp.where(std > 0, std, 1.0), 0.0))
    state = start, _loss(start, problem), jnp.asarray(FIRST_DAMPING), 0, jnp.asarray(False)
    estimate, *_ = jax.lax.while_loop(is_going_on, body, state)
    errors, counts = _errors(estimate, problem)
    error = jnp.where(counts, jnp.linalg.norm(errors, axis=-1), jnp.inf)
    return estimate.T_ref_view, estimate.points, unknowns.distortion_std * estimate.lens, error
