"""Scale, noise and poses from a repeated prediction: two windows predict the same image."""

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.observation import Observation, Prediction, depth_in, sound, transform
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, nearest_pixel, project
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import stack
from emgs_jax.registration.noise import num_independent, robust_std
from emgs_jax.registration.rigid import MIN_PAIRS, fit_rigid, fit_rigid_robust, median, pose_row

LEAST_RATIO = 1e-6  # of a pixel's ratio of depths to their median; less is behind the camera


@full_precision
def repeat_scale(
    now: Observation,
    before: Observation,
    T_world_previous: jaxlie.SE3,
    otherwise: Float[Array, ""],
    reading: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Estimate a prediction's scale relative to the map, and its error, from the repeated prediction of an image (R8).

    The second value is the standard deviation of the log-scale: that of the pixels' log-ratios divided by the root of
    the number of independent ones, times √(π/2) for a median. It is 0 if both predictions are equal to the bit.

    Args:
        now: this call's prediction of the image, camera frame.
        before: the previous call's, aligned with the map, world frame.
        otherwise: scale with too few pairs.
        reading: row of `LocalizationConfig.coarse_scale`: 0 (1, as printed), 1 (median ratio of depths) or 2 (of the
            similarity that fits best).
    """
    now, before = sound(now), sound(before)
    depth_now = now.points[:, 2]
    paired = now.valid & before.valid & (depth_now > NEAREST_DEPTH)
    ratios = depth_in(T_world_previous, before) / jnp.where(paired, depth_now, 1.0)
    ratio = median(ratios, paired)
    is_positive = ratio > 0
    ratio = jnp.where(is_positive, ratio, 1.0)
    errors = jnp.where(paired, jnp.log(jnp.maximum(ratios / ratio, LEAST_RATIO)), 0.0)
    scatter = robust_std(errors, paired)
    count = num_independent(errors / jnp.maximum(scatter, 1e-6), now.points, paired)
    _, similarity = fit_rigid(now.points, before.points, paired.astype(jnp.float32))
    scale = jnp.where(reading == 1, jnp.where(is_positive, ratio, 0.0), similarity)
    is_found = (jnp.sum(paired) >= MIN_PAIRS) & jnp.isfinite(scale) & (scale > 0)
    scale = jnp.where(reading > 0, jnp.where(is_found, scale, otherwise), 1.0)
    return scale, jnp.sqrt(0.5 * jnp.pi / count) * scatter


def mean_depth_of(prediction: Prediction) -> Float[Array, ""]:
    """Compute the median depth of the previous image, or of the current one if that has none; the prediction's unit."""
    views = prediction.previous, prediction.current
    depths = [view.points[:, 2] for view in views]
    known = [view.valid & (depth > NEAREST_DEPTH) for view, depth in zip(views, depths, strict=True)]
    is_shown = jnp.any(known[0])
    return median(jnp.where(is_shown, depths[0], depths[1]), jnp.where(is_shown, known[0], known[1]))


@full_precision
def repeat_error(
    now: Observation,
    before: Observation,
    T_world_previous: jaxlie.SE3,
    scale: Float[Array, ""],
    otherwise: Float[Array, ""],
) -> Float[Array, ""]:
    """Compute the robust standard deviation (m) between two predictions of an image; `otherwise` without a pair."""
    paired = now.valid & before.valid
    apart = transform(T_world_previous, now, scale).points - before.points
    differs = jnp.any(apart != 0, axis=-1)  # a length has no gradient where it is 0
    apart = jnp.where(differs, jnp.linalg.norm(jnp.where(differs[:, None], apart, 1.0), axis=-1), 0.0)
    return jnp.where(jnp.any(paired), robust_std(apart, paired), otherwise)


@full_precision
def through_previous(
    prediction: Prediction,
    previous: Observation,
    T_world_previous: jaxlie.SE3,
    T_previous_current: jaxlie.SE3,
    scale: Float[Array, ""],
    camera: Camera,
    max_pair_distance: Float[Array, ""],
) -> tuple[jaxlie.SE3, jaxlie.SE3]:
    """Compute the current pose through the points of the previous image (R7): `via_previous` and `same_image`.

    Args:
        previous: the previous frame, aligned with the map, world frame.
        T_previous_current: the prior's motion, scaled.
        camera: of the rows.
        max_pair_distance: fraction of the depth; points farther apart are no pair.
    """
    now = prediction.previous
    carried, via = _pairs_via_previous(prediction, previous, scale, T_previous_current, camera, max_pair_distance)
    direct = scale * now.points, previous.points, now.valid & previous.valid, T_world_previous
    chained = scale * prediction.current.points, carried, via, T_world_previous @ T_previous_current
    fits = jax.vmap(fit_rigid_robust)(*stack([direct, chained]))  # side by side: one copy of the solve to compile
    return pose_row(fits, 1), pose_row(fits, 0) @ T_previous_current


def _pairs_via_previous(
    prediction: Prediction,
    previous: Observation,
    scale: Float[Array, ""],
    T_previous_current: jaxlie.SE3,
    camera: Camera,
    max_pair_distance: Float[Array, ""],
) -> tuple[Float[Array, "p 3"], Bool[Array, "p"]]:
    """Pair points by the printed chain: current point -> closest point of the previous image now -> same pixel before.

    The closest point is found by projection with the prior's `T_previous_current`, without a tree.

    Returns:
        A world-frame point for every current one, and which of these pairs exist.
    """
    now, current = prediction.previous, prediction.current
    seen = transform(T_previous_current, current, scale)
    pixels, depth = project(camera, seen.points)
    match, inside = nearest_pixel(pixels, (camera.height, camera.width))
    distance = jnp.linalg.norm(seen.points - scale * now.points[match], axis=-1)
    is_close = distance <= max_pair_distance * depth
    via = inside & (depth > 0) & is_close & (now.valid & previous.valid)[match] & current.valid
    return previous.points[match], via
