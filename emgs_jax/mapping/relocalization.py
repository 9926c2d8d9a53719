"""Relocalization of a camera that is lost, or new in a saved map, and restart where that fails for long.

The prior's poses are in a world of its own, which a relocalized frame anchors in that of the map.
"""

from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.back_end.loops import relocalize_frame
from emgs_jax.back_end.state import BackEnd
from emgs_jax.device.arrays import to_se3
from emgs_jax.gaussian_map import grow
from emgs_jax.loop_closure.relocalization import RelocalizationConfig, RelocalizedPose
from emgs_jax.mapping.capacity import advance, restart_map
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.records import IN_MAP, RELOCALIZED, RESTARTED, FrameRecord
from emgs_jax.mapping.run import MappingRun, TrackedFrame
from emgs_jax.mapping.window_input import PlacedStructure, WindowInput
from emgs_jax.motion import no_looks
from emgs_jax.observation import Prediction, depth_in, transform
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.registration.rigid import pose_row, scale_translation
from emgs_jax.slam import SlamState, StepInfo

FINE_POSE = "fine_pose"  # reason of a rejection: at the relocalized pose the frame does not fit the map
UNKNOWN = np.full((4, 4), np.nan)  # pose


def relocalize_lost(
    before: MappingRun, run: MappingRun, frame: TrackedFrame, window: WindowInput
) -> tuple[MappingRun, TrackedFrame]:
    """Relocalize a lost camera, and repeat its step at the pose found; restart the map where that fails for long.

    `location` of the frame tells the outcome.

    Args:
        run: after the step, with the pose that it has estimated.
    """
    if not is_relocalization_due(before, frame.info):
        return run, frame
    found, relocalized = _step_relocalized(before, window, frame)
    if relocalized.location == RELOCALIZED:
        return found, relocalized
    if frame.info is None or not is_restart_due(before, window, run.state, frame.info):
        return run, replace(frame, location=relocalized.location)
    state, config = restart_map(run.state, run.camera, run.config)
    return replace(run, state=state, config=config), replace(frame, location=RESTARTED)


def _step_relocalized(run: MappingRun, window: WindowInput, frame: TrackedFrame) -> tuple[MappingRun, TrackedFrame]:
    """Relocalize a lost camera, and run the step from the pose found; `location` tells whether the map accepts it."""
    place, failure = relocalize_frame(run.back_end, window.data[0])
    if place is None:
        return run, replace(frame, location=failure)
    prediction, is_known = frame.prediction, is_related(run, window)
    if not is_known:
        prediction = in_structure(prediction, window, place_structure(window, place.T_world_camera))
    state, again = relocalized_start(run, prediction, place, has_other_unit=not is_known)
    state, info, config = advance(state, again, run.camera, run.config)
    failure = rejection(info, again, place, run.back_end.config.relocalization)
    return replace(run, state=state, config=config), replace(frame, info=info, location=failure or RELOCALIZED)


def is_relocalization_due(run: MappingRun, info: StepInfo | None) -> bool:
    """Test whether relocalization is due: no pose is known yet, or no frame has been tracked for a while."""
    if run.back_end is None or (run.state is None and run.saved is None):
        return False
    return info is None or _num_untracked(run, info) >= run.back_end.config.relocalization.patience


def is_restart_due(run: MappingRun, window: WindowInput, state: SlamState, info: StepInfo) -> bool:
    """Test whether the map restarts from a frame that was not relocalized, at the pose that the prior predicts.

    Only after many untracked frames, and where the prior connects a frame in the map with this one and knows what it
    sees: there are points, and its two predictions of the previous image agree.

    Args:
        run: before this frame.
        state: after its step.
    """
    count = _num_untracked(run, info)
    is_due = not run.is_fixed and count >= run.back_end.config.relocalization.max_patience
    if not is_due or not np.any(state.previous.valid) or not _is_connected(run.back_end, window):
        return False
    depths = np.asarray(depth_in(state.T_world_previous, state.previous))
    depth = np.median(depths[np.asarray(state.previous.valid)])
    return bool(info.localization.repeat_rms <= run.config.localization.max_residual * depth)


def _is_connected(end: BackEnd, window: WindowInput) -> bool:
    """Test whether a chain of predictions, each of two consecutive frames, leads from the map to the given frame.

    Frames that the prior itself has lost are skipped, where a later prediction shows frames of both sides. The anchor
    does not count as a link: a prior that has lost the connection predicts a pose of the anchor, too.
    """
    here, before = (window.T_anchor_views.get(window.frames[0].index - offset) for offset in (0, 1))
    if here is None or before is None or not np.isfinite([here, before]).all():
        return False
    parents = {e.a: e.b for e in end.factors if not e.is_loop and (e.b > end.first_node or e.a == e.b + 1)}
    node = len(end.nodes) - 1
    while not end.nodes[node].is_placed:
        if node not in parents:
            return False
        node = parents[node]
    return True


def _num_untracked(run: MappingRun, info: StepInfo) -> int:
    """Count the last frames in a row that are not tracked, the one of `info` included."""
    placed = [row for row, record in enumerate(run.records) if record.status in IN_MAP]
    return 0 if info.localization.is_tracked else len(run.records) - (placed[-1] if placed else -1)


def step_prediction(run: MappingRun, window: WindowInput) -> Prediction:
    """Return a step's prediction in the world of the map; without poses where they are not related to it."""
    prediction = as_step_prediction(window.prediction)
    if run.structure is None or not is_related(run, window):
        return prediction
    return in_structure(prediction, window, run.structure)


def in_structure(prediction: Prediction, window: WindowInput, placed: PlacedStructure) -> Prediction:
    """Transform a step's input from the prior's own world to that of the map."""
    here = window.frames[0].index
    rows = here - 1, here, here + int(prediction.has_newest)
    T_world_views = placed.T_world_structure @ np.stack([window.T_anchor_views.get(row, UNKNOWN) for row in rows])
    return replace(prediction, T_world_views=to_se3(T_world_views), T_world_anchor=to_se3(placed.T_world_anchor))


def is_related(run: MappingRun, window: WindowInput) -> bool:
    """Test whether the predicted poses are in a world whose pose in the map is known."""
    return window.structure == (0 if run.structure is None else run.structure.number)


def place_structure(window: WindowInput, pose: np.ndarray) -> PlacedStructure:
    """Place the prior's own world by the pose of the current frame in the map; lengths are scaled about that frame."""
    own = window.T_anchor_views.get(window.frames[0].index, UNKNOWN)
    return PlacedStructure(window.structure, pose @ np.linalg.inv(own), pose)


def reanchor_prior(run: MappingRun, window: WindowInput) -> MappingRun:
    """Anchor the prior's world at the last frame, if relocalization has found its pose."""
    last = run.records[-1]
    if last.location != RELOCALIZED:
        return run
    if is_related(run, window):
        return replace(run, prior_motion=anchor_motion_of(last, step_prediction(run, window)))
    # The prior continues in a world of its own, which moves with this frame.
    return replace(run, structure=place_structure(window, last.pose), prior_motion=jaxlie.SE3.identity())


def as_step_prediction(opening: FirstWindow | Prediction) -> Prediction:
    """Convert the first view of a sequence to a step's input; return a step's input as it is."""
    if isinstance(opening, Prediction):
        return opening
    view, T = jax.tree.map(lambda leaf: leaf[0], opening.views), pose_row(opening.T_world_views, 0)
    return Prediction(
        current=view,
        previous=view,
        T_world_views=jaxlie.SE3(jnp.stack([T.wxyz_xyz] * 3)),
        T_world_anchor=T,
        pose_covariance=opening.pose_covariance[0],
        scale_std=opening.scale_std[0],
        has_newest=jnp.asarray(False),
        is_repeat=jnp.asarray(False),
    )


def state_in_saved_map(run: MappingRun, prediction: Prediction) -> SlamState:
    """Return a state in the saved map, with the structure that a checkpoint's state needs."""
    time = jnp.asarray(len(run.back_end.nodes), jnp.int32)
    looks = no_looks(prediction.current, run.config.motion)
    return SlamState(run.saved.map, prediction.current, prediction.T_world_anchor, exact_estimate(), time, looks)


def relocalized_start(
    run: MappingRun, prediction: Prediction, location: RelocalizedPose, has_other_unit: bool = False
) -> tuple[SlamState, Prediction]:
    """Return a state and prediction whose step starts at the relocalized pose: this frame is its own previous one.

    This frame determines the prior's unit in a saved map, and with `has_other_unit`: the prior's lengths are no longer
    those of the steps before.

    Raises:
        ValueError: the features of a saved map are not as wide as those of this run.
    """
    T, scale = to_se3(location.T_world_camera), jnp.exp(jnp.asarray(location.log_scale, jnp.float32))
    placed = move_prediction(prediction, anchor_motion(prediction, T, scale))
    views = placed.T_world_views.wxyz_xyz[jnp.array([1, 1, 2])]
    again = replace(placed, previous=placed.current, T_world_views=jaxlie.SE3(views), is_repeat=jnp.asarray(False))
    covariance, log_scale = (jnp.asarray(x, jnp.float32) for x in (location.covariance, location.log_scale))
    state = state_in_saved_map(run, prediction) if run.state is None else run.state
    estimate = replace(state.estimate, covariance=covariance)
    if run.state is None:
        widths = state.map.gaussians.features.shape[-1], prediction.current.features.shape[-1]
        if widths[0] != widths[1]:
            raise ValueError(
                f"the features of the saved map have width {widths[0]} and those of this run {widths[1]}: use prior= "
                "and features= that it was mapped with"
            )
        estimate = replace(estimate, depth_noise=jnp.asarray(run.saved.depth_noise, jnp.float32))
    if run.state is None or has_other_unit:
        estimate = replace(estimate, log_scale=log_scale)
    seen = transform(T, prediction.current, scale)
    return replace(state, previous=seen, T_world_previous=T, estimate=estimate), again


def anchor_motion(prediction: Prediction, T_world_camera: jaxlie.SE3, scale: jnp.ndarray) -> jaxlie.SE3:
    """Return the motion of the prior's world that brings its own current pose, scaled about the anchor, to this one."""
    anchor, current = prediction.T_world_anchor, pose_row(prediction.T_world_views, 1)
    return T_world_camera @ scale_translation(anchor.inverse() @ current, scale).inverse() @ anchor.inverse()


def anchor_motion_of(record: FrameRecord, prediction: Prediction) -> jaxlie.SE3:
    """Return `anchor_motion` by the pose and scale of a relocalized frame."""
    return anchor_motion(prediction, to_se3(record.pose), jnp.asarray(record.scale, jnp.float32))


def move_prediction(prediction: Prediction, motion: jaxlie.SE3 | None) -> Prediction:
    """Apply a motion of the prior's world to a prediction; None changes nothing.

    It comes of relocalization, so that how sure the prior is of its poses in its own world says little of them here.
    """
    if motion is None:
        return prediction
    views = [motion @ pose_row(prediction.T_world_views, row) for row in range(3)]
    views = jaxlie.SE3(jnp.stack([view.wxyz_xyz for view in views]))
    unknown = jnp.full_like(prediction.pose_covariance, jnp.nan)
    anchor = motion @ prediction.T_world_anchor
    return replace(prediction, T_world_views=views, T_world_anchor=anchor, pose_covariance=unknown)


def rejection(
    info: StepInfo, prediction: Prediction, location: RelocalizedPose, config: RelocalizationConfig
) -> str | None:
    """Return why the map rejects a relocalized pose (too few inliers, or they move it too far); None if it does not."""
    found, current = info.localization, prediction.current
    depth = np.median(np.asarray(current.points[:, 2])[np.asarray(current.valid)]) * np.exp(location.log_scale)
    agrees = bool(found.is_tracked) and float(found.icp.inlier_fraction) >= config.min_inlier_fraction
    stays = found.step_m <= config.max_step * depth and np.degrees(found.step_rad) <= config.max_step_deg
    return None if agrees and stays else FINE_POSE


def not_found_message(run: MappingRun) -> str:
    """Build the error message of a run of which no frame was relocalized in the saved map, with the reasons."""
    counts = Counter(record.location for record in run.records if record.location is not None)
    reasons = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    return (
        f"none of the {len(run.records)} frames is found in the saved map ({reasons or 'none has points and a pose'}): "
        "take images of the same place, or map it anew without map="
    )


def with_saved_map(run: MappingRun) -> MappingRun:
    """Restore the saved map of a run that keeps it as it is, with the capacity that the step needs."""
    map, capacity = run.saved.map, run.config.submap.map_capacity
    map = grow(map, capacity) if capacity > map.weight.shape[0] else map
    return replace(run, state=replace(run.state, map=map))
