"""Estimate of a frame's pose and scale: prediction and correction of a Kalman filter from frame to frame.

The error of a pose T and a scale s, relative to the map, is T Exp(ξ) and s e^σ with (ξ, σ) ~ N(0, P), in the order
translation (m), rotation (rad), logarithm of the scale. Errors of the map itself are not included; at the
end of a run `mapping/finalize.py` adds those of the first frame.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.linalg import ROUNDED_CORRELATION
from emgs_jax.ops.precision import full_precision
from emgs_jax.registration.icp import IcpInfo
from emgs_jax.registration.pose_noise import Repeats, no_repeats, rescale_repeats
from emgs_jax.registration.problem import pose_worth

DEGREES = 7


class PoseEstimate(eqx.Module):
    """Estimate from the last frame, from which the next step starts, besides the pose itself.

    Args:
        covariance: P of its pose and scale, relative to the map.
        depth_noise: difference between its points and the map, as a fraction of their depth.
        log_scale: mean logarithm of the scales of the tracked frames: the prior's own unit, in that of the map.
        repeats: differences between repeated predictions of one pose.
        is_given: the prior states the uncertainty of this frame's pose. Then its poses lie in one world with one unit,
            and how well points fit says nothing about them.
    """

    covariance: Float[Array, "*b 7 7"]
    depth_noise: Float[Array, "*b"]
    log_scale: Float[Array, "*b"]
    num_scales: Float[Array, "*b"]
    repeats: Repeats
    is_given: Bool[Array, "*b"]


def exact_estimate() -> PoseEstimate:
    """Return the estimate of the frame that makes the map: its pose is exact, and its scale is the unit."""
    return PoseEstimate(jnp.zeros((DEGREES, DEGREES)), *jnp.zeros((2,)), jnp.ones(()), no_repeats(), jnp.asarray(False))


@full_precision
def propagate_covariance(
    covariance: Float[Array, "7 7"], T_previous_current: jaxlie.SE3, noise: Float[Array, "7 7"]
) -> Float[Array, "7 7"]:
    """Propagate P to the current frame: A P A' + Q, with A the adjoint of the motion's inverse and Q = `noise`.

    The effect of the scale's error on the length of the motion is neglected: it is small against `noise`. A motion that
    is not finite counts as none.
    """
    adjoint = T_previous_current.inverse().adjoint()
    adjoint = jnp.where(jnp.all(jnp.isfinite(adjoint)), adjoint, jnp.eye(DEGREES - 1))
    A = jnp.eye(DEGREES).at[:-1, :-1].set(adjoint)
    return A @ covariance @ A.T + noise


@full_precision
def kalman_update(
    covariance: Float[Array, "7 7"], difference: Float[Array, "7"], information: Float[Array, "7 7"]
) -> tuple[Float[Array, "7"], Float[Array, "7 7"]]:
    """Correct an estimate by a measurement: the step (ξ, σ) of the mean, (P⁻¹ + W)⁻¹ W d, and the new P, (P⁻¹ + W)⁻¹.

    Args:
        covariance: P, which may be singular.
        difference: d, the innovation: the measurement relative to the estimate.
        information: W of the measurement; zero in directions that are not measured.
    """
    root = _root(covariance)
    # As a square, which remains a covariance however much P and W differ between directions.
    inner = jnp.linalg.cholesky(jnp.eye(DEGREES) + root.T @ information @ root)
    half = jax.scipy.linalg.solve_triangular(inner, root.T, lower=True)
    posterior = half.T @ half
    return posterior @ information @ difference, posterior


def rescale_estimate(estimate: PoseEstimate, factor: Float[Array, ""]) -> PoseEstimate:
    """Return the estimate after all lengths of the map are multiplied by `factor`."""
    units = jnp.ones(DEGREES).at[:3].set(factor)
    return eqx.tree_at(
        lambda b: (b.covariance, b.log_scale, b.repeats),
        estimate,
        (
            units[:, None] * estimate.covariance * units,
            estimate.log_scale + jnp.log(factor),
            rescale_repeats(estimate.repeats, factor),
        ),
    )


def propagate(estimate: PoseEstimate, T_previous_current: jaxlie.SE3, noise: Float[Array, "7 7"]) -> PoseEstimate:
    """Propagate the estimate to the current frame, before any measurement; see `propagate_covariance`."""
    covariance = propagate_covariance(estimate.covariance, T_previous_current, noise)
    return eqx.tree_at(lambda b: b.covariance, estimate, covariance)


def correct(
    estimate: PoseEstimate, difference: Float[Array, "7"], information: Float[Array, "7 7"]
) -> tuple[Float[Array, "7"], PoseEstimate]:
    """Correct the estimate by a measurement: return the step of the mean, and the estimate; see `kalman_update`."""
    step, covariance = kalman_update(estimate.covariance, difference, information)
    return step, eqx.tree_at(lambda b: b.covariance, estimate, covariance)


@full_precision
def root_information(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Compute L⁻¹ of P = L L': |L⁻¹ x|² is the squared Mahalanobis distance of x. No variance of P may be 0."""
    return jax.scipy.linalg.solve_triangular(_root(covariance), jnp.eye(covariance.shape[0]), lower=True)


def _root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Factor P = L L' by its correlations, so that units of different size do not round each other."""
    variances = jnp.diagonal(covariance)
    std = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    correlation = covariance / std / std[:, None] + ROUNDED_CORRELATION * jnp.eye(std.shape[0])
    return jnp.where(variances > 0, std, 0.0)[:, None] * jnp.linalg.cholesky(correlation)


@full_precision
def correct_by_points(
    estimate: PoseEstimate,
    found: IcpInfo,
    depth_noise: Float[Array, ""],
    scale: Float[Array, ""],
    is_tracked: Bool[Array, ""],
    num_alike: Float[Array, ""],
) -> tuple[PoseEstimate, Float[Array, "6 6"]]:
    """Correct the estimate by the points of a frame; it stays unchanged if the frame is not tracked.

    Args:
        found: result of ICP.
        depth_noise: expected, as a fraction of the depth, see `pose_worth`.
        num_alike: frames that see one part of the map, whose error they share: the information of one frame's points
            about the scale is divided by it.

    Returns:
        The estimate, and the share of an error of the map that enters the pose: the points' gain if the prior knows the
        pose by itself, otherwise all of it, because the estimate is relative to the map.
    """
    worth, nothing = pose_worth(estimate.is_given, found.misfit, depth_noise), jnp.zeros(DEGREES)
    units = jnp.ones(DEGREES).at[-1].set(num_alike**-0.5)
    information = units[:, None] * found.information * units
    _, covariance = kalman_update(worth[:, None] * estimate.covariance * worth, nothing, information)
    gain = jnp.where(is_tracked, (covariance @ information)[:-1, :-1], 0.0)
    # Poses with a stated uncertainty have a known unit, whatever the scales of the depths.
    num_scales = estimate.num_scales + jnp.where(estimate.is_given, 0.0, 1.0)
    change = jnp.where(estimate.is_given, 0.0, jnp.log(scale) - estimate.log_scale)
    log_scale = estimate.log_scale + change / num_scales
    # The next frame repeats these predicted poses, whether the points fit or not.
    estimate = eqx.tree_at(lambda b: b.repeats, estimate, rescale_repeats(estimate.repeats, scale))
    after = PoseEstimate(covariance, found.misfit, log_scale, num_scales, estimate.repeats, estimate.is_given)
    after = jax.tree.map(lambda new, old: jnp.where(is_tracked, new, old), after, estimate)
    return after, jnp.where(estimate.is_given, gain, jnp.eye(DEGREES - 1))
