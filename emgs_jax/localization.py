"""Localization (Method C): the pose of the current frame, first through the previous frame, then against the map."""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import GaussianIndex, Gaussians
from emgs_jax.observation import Observation, Prediction, transform
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.constants import MAD_TO_STD
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, stack, traced
from emgs_jax.registration.depth_field import DepthField, field_at
from emgs_jax.registration.icp import IcpInfo, icp
from emgs_jax.registration.noise import levels_of
from emgs_jax.registration.pose_estimate import (
    PoseEstimate,
    correct,
    correct_by_points,
    exact_estimate,
    propagate,
    root_information,
)
from emgs_jax.registration.pose_noise import (
    LEAST_NOISE,
    NO_INFORMATION,
    axis_std,
    is_given_pose,
    no_repeats,
    pose_covariances,
    repeat_poses,
)
from emgs_jax.registration.problem import CoarseStart, IcpConfig
from emgs_jax.registration.repeated_prediction import mean_depth_of, repeat_error, repeat_scale, through_previous
from emgs_jax.registration.rigid import MIN_PAIRS, pose_row, scale_translation

# Bits of LocalizationInfo.reason, with words for people.
REASONS = (
    "the prediction has no valid point or pose",
    "too few points agree with the map",
    "the residual against the map is too large",
    "the fine pose is too far from the coarse one",
    "the geometry does not determine the pose",
)

COARSE = ("via_previous", "same_image", "anchored", "fused")  # readings of `LocalizationConfig.coarse`
ANCHORED, FUSED = map(COARSE.index, ("anchored", "fused"))


class LocalizationConfig(eqx.Module):
    """Readings of the coarse step (R7, R8), settings of the fine step (R9), and the checks of a pose.

    Args:
        coarse: `via_previous` (printed): closest points in the previous image carry over to its earlier prediction;
            `same_image`: the two predictions of the previous image directly; `anchored`: the prior's own pose;
            `fused`: the previous pose with the prior's motion, and `anchored`, weighted by their uncertainties. The
            prior may state these; else they are estimated.
        coarse_scale: `none` (printed), `ratio` (median ratio of the depths that were predicted twice) or
            `estimated` (similarity fit).
        scale_std: standard deviation of log-scales about their running mean, as if errors of frames were independent;
            choose it larger the longer errors last. inf: only map and repeated predictions hold the scale (printed).
        max_pair_distance: fraction of the depth; points farther apart are no pair.
        pose_shared: part of the variance of the prior's poses that two predictions of one pose share, see `pose_std`;
            1: their differences are ignored and those of depths used (printed).
        num_alike: frames that see one part of the map with the same error, see `correct_by_points`.
        num_shared: frames whose windows share images: this many differences of repeated predictions count, see
            `repeat_poses`. The first frame is half as many motions from the middle of its window, see `own_covariance`.
        min_inlier_fraction: smallest fraction of inliers among the points for which the fine pose is accepted.
        max_residual: root mean square distance to the map's planes, as a fraction of the depth; not checked for a pose
            that is well known without the points, see `CoarsePose.is_placed`.
        max_step: between the coarse and the fine pose, as a fraction of the mean depth.
        max_step_rad: likewise, rad.
        max_pose_std: standard deviation of the pose in its least certain direction, by prior and points: of the
            translation as a fraction of the depth, of the rotation in rad.
    """

    coarse: Float[Array, "*b"] = choice(*COARSE)
    coarse_scale: Float[Array, "*b"] = choice("none", "ratio", "estimated")
    scale_std: Float[Array, "*b"] = traced(low=1e-4, high=math.inf)
    pose_shared: Float[Array, "*b"] = traced(low=0, high=1)
    num_alike: Float[Array, "*b"] = traced(low=1, high=math.inf)
    num_shared: Float[Array, "*b"] = traced(low=1, high=math.inf)
    icp: IcpConfig
    max_pair_distance: Float[Array, "*b"] = traced(0.05, low=0, high=math.inf)
    min_inlier_fraction: Float[Array, "*b"] = traced(0.1, low=0, high=1)
    max_residual: Float[Array, "*b"] = traced(0.05, low=0, high=math.inf)
    max_step: Float[Array, "*b"] = traced(0.15, low=0, high=math.inf)
    max_step_rad: Float[Array, "*b"] = traced(0.3, low=0, high=math.inf)
    max_pose_std: Float[Array, "*b"] = traced(0.1, low=0, high=math.inf)


class CoarsePose(eqx.Module):
    """Result of the coarse step.

    Args:
        T_world_newest: temporary pose of the newest image (the current one's without a newer image).
        scale: of this prediction, about its cameras' origins.
        repeat_rms: m; difference between the two predictions of the previous image, after alignment.
        mean_depth: m; of the previous image, or of this one if that has no depth, scaled.
        depth_noise: as a fraction; the larger of this difference and that of the previous frame from the map.
        estimate: covariance of this pose and scale; the rest is that of the previous frame.
        is_known: False if the prediction has no pose; then this is the pose of the previous frame.
        is_usable: False if the prediction has no valid point or no pose.
        has_field: False if depths are triangulated with the poses, which the prior states by a certain scale. Their
            errors are then of pixels, and what looks like a field is an error of the map.
        is_placed: True if the prior has the pose from elsewhere than these depths, and more accurately than they would
            give it. A difference from the map is then the depths' error, and no reason to doubt the pose.
    """

    T_world_camera: jaxlie.SE3
    T_world_newest: jaxlie.SE3
    scale: Float[Array, ""]
    repeat_rms: Float[Array, ""]
    mean_depth: Float[Array, ""]
    depth_noise: Float[Array, ""]
    estimate: PoseEstimate
    is_known: Bool[Array, ""]
    is_usable: Bool[Array, ""]
    has_field: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.ones((), bool))
    is_placed: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))


class LocalizationInfo(eqx.Module):
    """Outcome of one frame.

    Args:
        reason: bits into `REASONS`; 0 for a tracked frame.
        repeat_rms: see `CoarsePose`.
        depth_noise: of the points, as a fraction of their depth: their difference from the map.
        noise: likewise for each row, measured on the points of its level of confidence.
        step_m: between the coarse and the fine pose.
        by_map: share of an error of the map that enters the pose, see `correct_by_points`.
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
    estimate: PoseEstimate
    by_map: Float[Array, "6 6"]
    icp: IcpInfo


def _ratio_noise(
    depth_noise: Float[Array, ""], ratio_std: Float[Array, ""], is_firm: Bool[Array, ""], config: LocalizationConfig
) -> Float[Array, ""]:
    """Estimate the variance of the logarithm of the ratio of two frames' scales.

    Depths that are repeated exactly hold the scale, because drift of the scale and of the pose look alike. A firm pose
    tells them apart.
    """
    guess = depth_noise * config.icp.scale_noise
    ratio = jnp.where(config.coarse_scale > 0, jnp.maximum(ratio_std, jnp.where(is_firm, guess, 0.0)), guess)
    return jnp.maximum(jnp.where(config.icp.scale_noise > 0, ratio, 0.0), NO_INFORMATION) ** 2


def _no_motion(mean_depth: Float[Array, ""], config: LocalizationConfig) -> Float[Array, "7"]:
    """Give standard deviations for an unknown motion: the largest fine step, at most a depth, a radian and e."""
    step = jnp.stack([config.max_step, config.max_step_rad, config.scale_std])
    return jnp.minimum(step, 1.0)[jnp.array([0, 0, 0, 1, 1, 1, 2])] * jnp.ones(7).at[:3].set(mean_depth)


def _readings(
    prediction: Prediction,
    previous: Observation,
    T_world_previous: jaxlie.SE3,
    scales: tuple[Float[Array, ""], Float[Array, ""]],
    camera: Camera,
    config: LocalizationConfig,
) -> tuple[jaxlie.SE3, jaxlie.SE3, jaxlie.SE3, Bool[Array, ""]]:
    """Compute the prior's motion from the previous frame, its own pose of the current one, and every reading (R7).

    The last value is True if the prior connects the previous frame with this one. If not, its own pose replaces the
    broken chain.

    Args:
        scales: of the prediction's depths, and of its poses.
    """
    scale, unit = scales
    anchor, paired = prediction.T_world_anchor, prediction.previous.valid & previous.valid
    raw_previous, raw_current = pose_row(prediction.T_world_views, 0), pose_row(prediction.T_world_views, 1)
    motion = scale_translation(raw_previous.inverse() @ raw_current, unit)
    anchored = anchor @ scale_translation(anchor.inverse() @ raw_current, unit)
    chain = T_world_previous @ motion
    # Only if a reading needs it: two robust fits over all points.
    via_previous, same_image = jax.lax.cond(
        config.coarse < ANCHORED,
        lambda: through_previous(
            prediction, previous, T_world_previous, motion, scale, camera, config.max_pair_distance
        ),
        lambda: (chain, chain),
    )
    linked = stack([via_previous, same_image, chain]).wxyz_xyz
    is_linked = (jnp.sum(paired) >= MIN_PAIRS) & jnp.all(jnp.isfinite(linked), axis=-1)
    via_previous, same_image, chain = map(jaxlie.SE3, jnp.where(is_linked[:, None], linked, anchored.wxyz_xyz))
    return motion, anchored, stack([via_previous, same_image, anchored, chain]), is_linked[2]


def _correct_by_prior(
    T_world_camera: jaxlie.SE3,
    scale: Float[Array, ""],
    anchored: tuple[jaxlie.SE3, Float[Array, "6 6"]],
    estimate: PoseEstimate,
    scale_std: Float[Array, ""],
    config: LocalizationConfig,
) -> tuple[jaxlie.SE3, Float[Array, ""], PoseEstimate]:
    """Correct pose, scale and their estimate by the prior's own pose (`fused` only) and the prior's own unit.

    A prior that has lost its anchor is completely wrong, and for long. So its pose has a Cauchy weight by its distance
    from the estimate, w = 1 / (1 + χ² / 6).

    Args:
        T_world_camera: estimate before the measurement.
        scale: likewise.
        anchored: the prior's own pose, and its covariance.
        scale_std: of the logarithm of the scale, about that of the prior's own unit.
    """
    pose, covariance = anchored
    apart = (T_world_camera.inverse() @ pose).log()
    is_used = (config.coarse == FUSED) & jnp.all(jnp.isfinite(apart)) & jnp.all(jnp.isfinite(covariance))
    apart, covariance = jnp.where(is_used, apart, 0.0), jnp.where(is_used, covariance, jnp.eye(6))
    innovation, root = (root_information(P) for P in (estimate.covariance[:-1, :-1] + covariance, covariance))
    weight = is_used / (1.0 + jnp.sum((innovation @ apart) ** 2) / apart.shape[0])
    difference = jnp.append(apart, estimate.log_scale - jnp.log(scale))
    information = jnp.zeros((7, 7)).at[:6, :6].set(weight * root.T @ root).at[6, 6].set(scale_std**-2)
    step, estimate = correct(estimate, difference, information)
    return T_world_camera @ jaxlie.SE3.exp(step[:-1]), scale * jnp.exp(step[-1]), estimate


@full_precision
def localize_coarse(
    prediction: Prediction,
    previous: Observation,
    T_world_previous: jaxlie.SE3,
    camera: Camera,
    config: LocalizationConfig,
    estimate: PoseEstimate | None = None,
) -> CoarsePose:
    """Register the frame coarsely through the previous one, which was predicted twice, and fuse the prior's own pose.

    Args:
        previous: the previous frame, aligned with the map, world frame.
        camera: of the (thinned) rows.
        estimate: of the previous frame; None: its pose is exact.
    """
    now, estimate = prediction.previous, exact_estimate() if estimate is None else estimate
    scale, ratio_std = repeat_scale(now, previous, T_world_previous, jnp.exp(estimate.log_scale), config.coarse_scale)
    mean_depth = scale * mean_depth_of(prediction)
    unknown = MAD_TO_STD * config.max_pair_distance * mean_depth  # without a repeated prediction
    repeat_rms = repeat_error(now, previous, T_world_previous, scale, unknown)
    depth_noise = jnp.maximum(jnp.maximum(repeat_rms / mean_depth, estimate.depth_noise), LEAST_NOISE)
    # As printed, there is no prior knowledge.
    is_given = is_given_pose(prediction) & (config.icp.prior_information > 0)
    own_unit = jnp.exp(estimate.log_scale)
    unit = jnp.where(is_given, own_unit, scale)
    motion, anchored, forms, is_linked = _readings(
        prediction, previous, T_world_previous, (scale, unit), camera, config
    )
    repeats, latest = repeat_poses(prediction, estimate.repeats, scale, mean_depth, config.num_shared)
    guess = axis_std(repeats, latest, depth_noise, mean_depth, config.icp.prior_information, config.pose_shared)
    of_motion, of_pose = pose_covariances(prediction.pose_covariance, guess, mean_depth, unit)
    # More certain than without a stated uncertainty.
    is_firm = is_given & jnp.all(jnp.diagonal(of_pose) <= guess[1] ** 2)
    of_ratio = _ratio_noise(depth_noise, ratio_std, is_firm, config)
    noise = jnp.zeros((7, 7)).at[:6, :6].set(of_motion).at[6, 6].set(of_ratio)
    noise = jnp.where(is_linked, noise, jnp.diag(_no_motion(mean_depth, config) ** 2))
    estimate = propagate(estimate, motion, noise)
    # A pose with a stated uncertainty needs no other estimate of it.
    repeats = jax.tree.map(partial(jnp.where, is_given), no_repeats(), repeats)
    estimate = eqx.tree_at(lambda b: (b.repeats, b.is_given), estimate, (repeats, is_given))
    known = pose_row(forms, config.coarse.astype(jnp.int32)), scale
    is_sure = is_given & jnp.isfinite(prediction.scale_std)
    scale_std = jnp.where(is_sure, jnp.maximum(prediction.scale_std, LEAST_NOISE), config.scale_std)
    coarse, scale, estimate = _correct_by_prior(*known, (anchored, of_pose), estimate, scale_std, config)
    unit = jnp.where(is_given, own_unit, scale)
    is_finite = jnp.all(jnp.isfinite(coarse.wxyz_xyz))
    coarse = jaxlie.SE3(jnp.where(is_finite, coarse.wxyz_xyz, T_world_previous.wxyz_xyz))
    raw_current, raw_newest = pose_row(prediction.T_world_views, 1), pose_row(prediction.T_world_views, 2)
    newest = coarse @ scale_translation(raw_current.inverse() @ raw_newest, unit)
    has_newest = prediction.has_newest & is_finite & jnp.all(jnp.isfinite(newest.wxyz_xyz))
    newest = jaxlie.SE3(jnp.where(has_newest, newest.wxyz_xyz, coarse.wxyz_xyz))
    is_usable = is_finite & (jnp.sum(prediction.current.valid) >= MIN_PAIRS)
    has_field = ~(is_sure & (prediction.scale_std == 0))
    return CoarsePose(
        coarse,
        newest,
        scale,
        repeat_rms,
        mean_depth,
        depth_noise,
        estimate,
        is_finite,
        is_usable,
        has_field,
        is_placed=is_firm & has_field,
    )


def _corrected(current: Observation, field: DepthField) -> Observation:
    """Remove the field of depth errors from the points of a frame: x exp(-f)."""
    factor = jnp.exp(-field_at(field, current.points))
    return eqx.tree_at(lambda o: o.points, current, current.points * factor[:, None])


@full_precision
def localize_fine(
    current: Observation,
    submap: Gaussians,
    coarse: CoarsePose,
    config: LocalizationConfig,
    index: GaussianIndex | None = None,
) -> tuple[jaxlie.SE3, Observation, LocalizationInfo]:
    """Register the frame to the submap; if a check fails, the coarse pose and scale stay.

    Args:
        current: camera frame, unscaled.
        submap: Gaussians, world frame.
        index: of the submap; None builds it here.

    Returns:
        T_world_camera, the observation in the world frame, and the outcome.
    """
    scaled = transform(jaxlie.SE3.identity(), current, coarse.scale)
    known = root_information(coarse.estimate.covariance)
    start = CoarseStart(coarse.T_world_camera, known, coarse.depth_noise, coarse.estimate.is_given)
    fine, scale, info = icp(scaled, submap, start, config.icp, index)
    step = (coarse.T_world_camera.inverse() @ fine).log()
    # A length has no gradient at zero, which the step is to the bit with an exact prior; this has one.
    step_m, step_rad = (part @ safe_normalize(part) for part in (step[:3], step[3:]))
    failed = jnp.stack(
        [
            ~coarse.is_usable,
            ~(info.inlier_fraction >= config.min_inlier_fraction),
            ~((info.residual <= config.max_residual) | coarse.is_placed),
            ~((step_m <= config.max_step * coarse.mean_depth) & (step_rad <= config.max_step_rad)),
            ~(info.min_eigenvalue >= config.max_pose_std**-2),
        ]
    )
    is_tracked = ~jnp.any(failed)
    T = jaxlie.SE3(jnp.where(is_tracked, fine.wxyz_xyz, coarse.T_world_camera.wxyz_xyz))
    scale = coarse.scale * jnp.where(is_tracked, scale, 1.0)
    nodes = jnp.where(is_tracked & coarse.has_field, info.field.nodes, 0.0)
    info = eqx.tree_at(lambda i: i.field.nodes, info, nodes)
    aligned = transform(T, _corrected(current, info.field), scale)
    aligned = eqx.tree_at(lambda o: o.valid, aligned, aligned.valid & coarse.is_usable)
    bits = jnp.sum(failed * 2 ** jnp.arange(failed.shape[0]))
    estimate, by_map = correct_by_points(coarse.estimate, info, coarse.depth_noise, scale, is_tracked, config.num_alike)
    outcome = LocalizationInfo(
        is_tracked=is_tracked,
        is_lost=~coarse.is_known,
        reason=bits,
        scale=scale,
        repeat_rms=coarse.repeat_rms,
        depth_noise=info.misfit,
        noise=info.misfit_of_levels[levels_of(current.confidence, info.level_edges)],
        step_m=step_m,
        step_rad=step_rad,
        estimate=estimate,
        by_map=by_map,
        icp=info,
    )
    return T, aligned, outcome
