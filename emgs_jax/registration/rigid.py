"""Rigid motions: what jaxlie lacks, and fits of paired points."""

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.linalg import ROUNDED, SMALLEST_LENGTH
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.ranks import kth_smallest

MIN_PAIRS = 16  # fewer pairs of noisy points give no pose


def pose_row(poses: jaxlie.SE3, row: int | Int[Array, ""]) -> jaxlie.SE3:
    """Take one pose of a batch."""
    return jaxlie.SE3(poses.wxyz_xyz[row])


def scale_translation(T: jaxlie.SE3, scale: Float[Array, ""]) -> jaxlie.SE3:
    """Multiply the translation of a pose."""
    return jaxlie.SE3.from_rotation_and_translation(T.rotation(), scale * T.translation())


def median(values: Float[Array, "p"], valid: Bool[Array, "p"]) -> Float[Array, ""]:
    """Compute the lower median of the valid values; 1 without any."""
    count = jnp.sum(valid)
    middle = kth_smallest(values, valid, jnp.maximum(count - 1, 0)[None] // 2)[0]
    return jnp.where(count > 0, middle, 1.0)


@full_precision
def fit_rigid(
    source: Float[Array, "p 3"], target: Float[Array, "p 3"], weights: Float[Array, "p"]
) -> tuple[jaxlie.SE3, Float[Array, ""]]:
    """Fit T_target_source to paired points by weighted least squares; also return the scale of the best similarity.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    If all weights are 0: the identity and 1.
    """
    total = jnp.sum(weights)
    share = weights / jnp.where(total > 0, total, 1.0)
    source_mean, target_mean = share @ source, share @ target
    a, b = source - source_mean, target - target_mean
    moments = (share[:, None] * b).T @ a
    u, s, vt = jnp.linalg.svd(jax.lax.stop_gradient(moments))
    handed = jnp.array([1.0, 1.0, 1.0]).at[2].set(jnp.sign(jnp.linalg.det(u @ vt)))
    # Gradients of the rotation itself: those of its two factors are infinite if singular values are equal.
    signed, inner = s * handed, handed[:, None] * (u.T @ moments @ vt.T)
    both = signed[:, None] + signed
    is_known = both > ROUNDED * s[0]
    turn = jnp.where(is_known, (inner - inner.T) / jnp.where(is_known, both, 1.0), 0.0)
    rotation = (u * handed) @ ((jnp.eye(3) + _slope_only(turn)) @ vt)
    rotation = jnp.where(total > 0, rotation, jnp.eye(3))
    spread = share @ jnp.sum(a * a, axis=-1)
    size = s @ handed + _slope_only(jnp.trace(inner))
    scale = jnp.where(spread > 0, size / jnp.where(spread > 0, spread, 1.0), 1.0)
    T = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(rotation), target_mean - rotation @ source_mean)
    return T, scale


def _slope_only(values: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Return 0 with the derivatives of `values`."""
    return values - jax.lax.stop_gradient(values)


@full_precision
def fit_rigid_robust(
    source: Float[Array, "p 3"], target: Float[Array, "p 3"], paired: Bool[Array, "p"], start: jaxlie.SE3
) -> jaxlie.SE3:
    """Fit pairs rigidly, robust by three reweightings around the median distance; `start` with too few pairs."""
    size = median(jnp.sqrt(jnp.sum(source**2, axis=-1)), paired)

    def reweight(T: jaxlie.SE3, _: None) -> tuple[jaxlie.SE3, None]:
        difference = source @ T.rotation().as_matrix().T + T.translation() - target
        # Exact pairs: the square root has no gradient at 0.
        distance = jnp.sqrt(jnp.sum(difference**2, axis=-1) + (SMALLEST_LENGTH * size) ** 2)
        spread = jnp.maximum(median(distance, paired), 1e-6 * size)
        weights = jnp.where(paired, 1.0 / (1.0 + (distance / (2.0 * spread)) ** 2), 0.0)
        return fit_rigid(source, target, weights)[0], None

    T, _ = jax.lax.scan(reweight, start, length=3)
    keep = jnp.sum(paired) >= MIN_PAIRS
    return jaxlie.SE3(jnp.where(keep, T.wxyz_xyz, start.wxyz_xyz))
