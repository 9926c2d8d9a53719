"""Localization (Method C): where the current frame is, first through the previous frame, then against the map."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation, Prediction, depth_in, transform
from emgs_jax.ops.camera import Camera, nearest_pixel, project
from emgs_jax.ops.linalg import Whitening
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, stack, traced
from emgs_jax.registration.icp import IcpInfo, icp
from emgs_jax.registration.noise import confidence_levels
from emgs_jax.registration.problem import IcpConfig
from emgs_jax.registration.rigid import (
    MIN_PAIRS,
    fit_rigid,
    fit_rigid_robust,
    interpolate,
    median,
    pose_row,
    scale_translation,
)

# Bits of LocalizationInfo.reason; the words are for people.
REASONS = (
    "the prediction has no valid point or pose",
    "too few points agree with the map",
    "the residual against the map is too large",
    "the fine pose is too far from the coarse one",
    "the geometry does not determine the pose",
)

LEAST_NOISE = 5e-4  # of the depth


class LocalizationConfig(eqx.Module):
    """The coarse step's reading (R7, R8), the fine step (R9) and what a pose must pass.

    Args:
        coarse: `via_previous` (printed): closest points in the previous image carry over to its earlier prediction;
            `same_image`: the two predictions of the previous image directly; `anchored`: the prior's own pose;
            `fused`: `same_image` and `anchored` by their uncertainties.
        coarse_scale: `none` (printed), `ratio` (median ratio of the depths that were predicted twice) or
            `estimated` (similarity fit).
        scale_memory: power on the estimated scale; below 1 it is pulled towards the prior's own.
        max_pair_distance: fraction of the depth; farther points are no pair.
        anchor_noise: of `fused`: variance of the prior's own pose near the anchor, over that of the chain.
        anchor_range: m; of `fused`: distance from the anchor at which its standard deviation has doubled.
        icp: the fine step.
        min_inlier_fraction: of the points, below which the fine pose is not accepted.
        max_residual: root mean square distance to the map's planes, as a fraction of the depth.
        max_step: between the coarse and the fine pose, as a fraction of the mean depth.
        max_step_rad: likewise, rad.
        min_eigenvalue: of the Hessian, see `IcpInfo`.
    """

    coarse: Float[Array, "*b"] = choice("via_previous", "same_image", "anchored", "fused")
    coarse_scale: Float[Array, "*b"] = choice("none", "ratio", "estimated")
    scale_memory: Float[Array, "*b"] = traced(low=0, high=1)
    max_pair_distance: Float[Array, "*b"] = traced(low=0, high=math.inf)
    anchor_noise: Float[Array, "*b"] = traced(low=0, high=math.inf)
    anchor_range: Float[Array, "*b"] = traced(low=1e-6, high=math.inf)
    icp: IcpConfig
    min_inlier_fraction: Float[Array, "*b"] = traced(low=0, high=1)
    max_residual: Float[Array, "*b"] = traced(low=0, high=math.inf)
    max_step: Float[Array, "*b"] = traced(low=0, high=math.inf)
    max_step_rad: Float[Array, "*b"] = traced(low=0, high=math.inf)
    min_eigenvalue: Float[Array, "*b"] = traced(low=0, high=1e9)


class CoarsePose(eqx.Module):
    """Result of the coarse step.

    Args:
        T_world_camera: of the current frame.
        T_world_newest: temporary pose of the newest image (the current one's where there is none).
        scale: by which this prediction is multiplied about its cameras' origins.
        repeat_rms: m; disagreement of the two predictions of the previous image, after alignment.
        mean_depth: m; of the previous image, scaled.
        is_usable: False where the prediction has no valid point or pose.
    """

    T_world_camera: jaxlie.SE3
    T_world_newest: jaxlie.SE3
    scale: Float[Array, ""]
    repeat_rms: Float[Array, ""]
    mean_depth: Float[Array, ""]
    is_usable: Bool[Array, ""]


class LocalizationInfo(eqx.Module):
    """Outcome of one frame.

    Args:
        is_tracked: the fine pose passed every check.
        is_lost: not even the coarse pose is known.
        reason: bits into `REASONS`; 0 for a tracked frame.
        scale: of this prediction.
        repeat_rms: see `CoarsePose`.
        depth_noise: of the points, as a fraction of their depth: how much they differ from the map.
        noise: likewise of each point, as those of its level of confidence do, in the order of the rows.
        step_m: between the coarse and the fine pose.
        step_rad: likewise.
        icp: of the fine step.
    """

    is_tracked: Bool[Array, ""]
    is_lost: Bool[Array, ""]
    reason: Int[Array, ""]
    scale: Float[Array, ""]
    repeat_rms: Float[Array, ""]
    depth_noise: Float[Array, ""]
    noise: Float[Array, "p"]
    step_m: Float[Array, ""]
    step_rad: Float[Array, ""]
    icp: IcpInfo


def _repeat_scale(
    now: Observation, before: Observation, T_world_previous: jaxlie.SE3, paired: Array, config: LocalizationConfig
) -> Float[Array, ""]:
    """Scale of this prediction relative to the map, from the image that was predicted twice (R8)."""
    depth_now = now.points[:, 2]
    ratio = median(depth_in(T_world_previous, before) / jnp.where(paired, depth_now, 1.0), paired)
    _, similarity = fit_rigid(now.points, before.points, paired.astype(jnp.float32))
    scale = jnp.stack([jnp.ones(()), ratio, similarity])[config.coarse_scale.astype(jnp.int32)]
    return jnp.where(jnp.isfinite(scale) & (scale > 0.1), scale, 1.0) ** config.scale_memory


def _pairs_via_previous(
    prediction: Prediction,
    previous: Observation,
    scale: Float[Array, ""],
    T_previous_current: jaxlie.SE3,
    camera: Camera,
    config: LocalizationConfig,
) -> tuple[Float[Array, "p 3"], Bool[Array, "p"]]:
    """The printed chain (R7): current point -> closest point of the previous image now -> the same pixel before.

    The closest point is looked up by projection, which needs no tree, from `T_previous_current` of the prior.

    Returns:
        A world-frame point for every current one, and which of these pairs exist.
    """
    now, current = prediction.previous, prediction.current
    seen = transform(T_previous_current, current, scale)
    pixels, depth = project(camera, seen.points)
    match, inside = nearest_pixel(pixels, (camera.height, camera.width))
    distance = jnp.linalg.norm(seen.points - scale * now.points[match], axis=-1)
    is_close = distance <= config.max_pair_distance * depth
    via = inside & (depth > 0) & is_close & (now.valid & previous.valid)[match] & current.valid
    return previous.points[match], via


@full_precision
def localize_coarse(
    prediction: Prediction,
    previous: Observation,
    T_world_previous: jaxlie.SE3,
    camera: Camera,
    config: LocalizationConfig,
) -> CoarsePose:
    """Coarse registration through the previous frame, which was predicted twice, fused with the prior's own pose.

    Args:
        prediction: of this call.
        previous: the previous frame as it was aligned with the map, world frame.
        T_world_previous: its pose.
        camera: of the (thinned) rows.
        config: readings.
    """
    now = prediction.previous
    paired = now.valid & previous.valid
    scale = _repeat_scale(now, previous, T_world_previous, paired, config)
    views = prediction.T_world_views
    raw_previous, raw_current = pose_row(views, 0), pose_row(views, 1)
    T_previous_current = scale_translation(raw_previous.inverse() @ raw_current, scale)
    T_current_newest = scale_translation(raw_current.inverse() @ pose_row(views, 2), scale)

    carried, via = _pairs_via_previous(prediction, previous, scale, T_previous_current, camera, config)
    direct = scale * now.points, previous.points, paired, T_world_previous
    chained = scale * prediction.current.points, carried, via, T_world_previous @ T_previous_current
    fits = jax.vmap(fit_rigid_robust)(*stack([direct, chained]))  # side by side: one copy of the solve to compile
    same_image, via_previous = pose_row(fits, 0) @ T_previous_current, pose_row(fits, 1)
    anchor = prediction.T_world_anchor
    anchored = anchor @ scale_translation(anchor.inverse() @ raw_current, scale)
    # After a frame that could not be placed the chain is broken, and the prior's own pose stands in for it.
    is_linked = (jnp.sum(paired) >= MIN_PAIRS) & jnp.all(jnp.isfinite(same_image.wxyz_xyz))
    same_image = jaxlie.SE3(jnp.where(is_linked, same_image.wxyz_xyz, anchored.wxyz_xyz))
    reach = 1.0 + jnp.linalg.norm(anchored.translation() - anchor.translation()) / config.anchor_range
    fused = interpolate(same_image, anchored, 1.0 / (1.0 + config.anchor_noise * reach**2))
    forms = stack([via_previous, same_image, anchored, fused])
    coarse = pose_row(forms, config.coarse.astype(jnp.int32))

    rotation, origin = T_world_previous.rotation().as_matrix(), T_world_previous.translation()
    repeat_sq = jnp.sum((scale * now.points @ rotation.T + origin - previous.points) ** 2, axis=-1)
    # 1.4826 makes the median absolute deviation a standard deviation (Gaussian errors).
    # Without a pair nothing is known, and the pairing distance stands in.
    mean_depth = scale * median(now.points[:, 2], now.valid)
    unknown_sq = (config.max_pair_distance * mean_depth) ** 2
    repeat_rms = 1.4826 * jnp.sqrt(jnp.where(jnp.any(paired), median(repeat_sq, paired), unknown_sq))
    is_finite = jnp.all(jnp.isfinite(coarse.wxyz_xyz))
    coarse = jaxlie.SE3(jnp.where(is_finite, coarse.wxyz_xyz, T_world_previous.wxyz_xyz))
    newest = coarse @ T_current_newest
    has_newest = prediction.has_newest & is_finite & jnp.all(jnp.isfinite(newest.wxyz_xyz))
    newest = jaxlie.SE3(jnp.where(has_newest, newest.wxyz_xyz, coarse.wxyz_xyz))
    is_usable = is_finite & (jnp.sum(prediction.current.valid) >= MIN_PAIRS)
    return CoarsePose(
        T_world_camera=coarse,
        T_world_newest=newest,
        scale=scale,
        repeat_rms=repeat_rms,
        mean_depth=mean_depth,
        is_usable=is_usable,
    )


@full_precision
def localize_fine(
    current: Observation,
    submap: Gaussians,
    coarse: CoarsePose,
    config: LocalizationConfig,
    white: Whitening | None = None,
) -> tuple[jaxlie.SE3, Observation, LocalizationInfo]:
    """Fine registration against the submap; the coarse pose and scale stay where a check fails.

    Args:
        current: camera frame, unscaled.
        submap: Gaussians, world frame.
        coarse: result of `localize_coarse`.
        config: terms, gates and checks.
        white: `whitening` of the submap's covariances; None makes it here.

    Returns:
        T_world_camera, the observation in the world frame, and the outcome.
    """
    scaled = transform(jaxlie.SE3.identity(), current, coarse.scale)
    # The coarse pose is as good as two predictions of one image agree; the least keeps the solve well scaled.
    depth_noise = jnp.maximum(coarse.repeat_rms / coarse.mean_depth, LEAST_NOISE)
    noise = depth_noise * coarse.mean_depth, depth_noise
    fine, scale, info = icp(scaled, submap, coarse.T_world_camera, noise, config.icp, white)
    step = (coarse.T_world_camera.inverse() @ fine).log()
    step_m, step_rad = jnp.linalg.norm(step[:3]), jnp.linalg.norm(step[3:])
    failed = jnp.stack(
        [
            ~coarse.is_usable,
            ~(info.inlier_fraction >= config.min_inlier_fraction),
            ~(info.residual <= config.max_residual),
            ~((step_m <= config.max_step * coarse.mean_depth) & (step_rad <= config.max_step_rad)),
            ~(info.min_eigenvalue >= config.min_eigenvalue),
        ]
    )
    is_tracked = ~jnp.any(failed)
    T = jaxlie.SE3(jnp.where(is_tracked, fine.wxyz_xyz, coarse.T_world_camera.wxyz_xyz))
    scale = coarse.scale * jnp.where(is_tracked, scale, 1.0)
    aligned = transform(T, current, scale)
    aligned = eqx.tree_at(lambda o: o.valid, aligned, aligned.valid & coarse.is_usable)
    bits = jnp.sum(failed * 2 ** jnp.arange(failed.shape[0]))
    return (
        T,
        aligned,
        LocalizationInfo(
            is_tracked=is_tracked,
            is_lost=~coarse.is_usable,
            reason=bits,
            scale=scale,
            repeat_rms=coarse.repeat_rms,
            depth_noise=info.misfit,
            noise=info.misfit_of_levels[confidence_levels(current.confidence, current.valid)],
            step_m=step_m,
            step_rad=step_rad,
            icp=info,
        ),
    )
