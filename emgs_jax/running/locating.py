"""Relocalization of a camera that is lost, or new in a saved map: from its keyframe's pose the run goes on."""

from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.gaussian_map import GaussianMap, grow
from emgs_jax.graph.measurements import ODOMETRY
from emgs_jax.loops.location import Location, LocationConfig
from emgs_jax.observation import Prediction, depth_in, transform
from emgs_jax.registration.belief import certain
from emgs_jax.registration.rigid import pose_row, scale_translation
from emgs_jax.running.back_end import BackEnd
from emgs_jax.running.convert import FirstWindow, to_se3
from emgs_jax.running.inputs import Input
from emgs_jax.running.measuring import Look
from emgs_jax.running.record import PLACED, FrameRecord, MappingRun
from emgs_jax.slam import SlamState, StepInfo

FINE_POSE = "fine_pose"  # what refuses a place by which the frame does not fit the map


def is_missing(run: MappingRun, info: StepInfo | None) -> bool:
    """Test whether relocalization is due: no pose is known yet, or no frame has been tracked for a while."""
    if run.back_end is None or (run.state is None and run.saved is None):
        return False
    return info is None or _num_untracked(run, info) >= run.back_end.config.location.patience


def is_to_begin_anew(run: MappingRun, given: Input, state: SlamState, info: StepInfo) -> bool:
    """Test whether the map restarts from a frame that was not relocalized, at the pose that the prior predicts.

    Only after many untracked frames, and where the prior connects a frame in the map with this one and knows what it
    sees: there are points, and its two predictions of the previous image agree.

    Args:
        run: before this frame.
        given: this frame.
        state: after its step.
        info: of its step.
    """
    count = _num_untracked(run, info)
    is_due = not run.is_fixed and count >= run.back_end.config.location.max_patience
    if not is_due or info.localization.is_lost or not _leads_here(run.back_end, given):
        return False
    depths = np.asarray(depth_in(state.T_world_previous, state.previous))
    depth = np.median(depths[np.asarray(state.previous.valid)])
    return bool(info.localization.repeat_rms <= run.config.localization.max_residual * depth)


def _leads_here(end: BackEnd, given: Input) -> bool:
    """Test whether a chain of predictions, each of two consecutive frames, leads from the map to the given frame.

    Frames that the prior itself has lost are skipped, where a later prediction shows frames of both sides. The anchor
    does not count as a link: a prior that has lost the connection predicts a pose of the anchor, too.
    """
    here, before = (given.T_anchor_views.get(given.frames[0].index - offset) for offset in (0, 1))
    if here is None or before is None or not np.isfinite([here, before]).all():
        return False
    leads = {e.a: e.b for e in end.edges if e.kind == ODOMETRY and (e.b > end.first or e.a == e.b + 1)}
    node = len(end.poses) - 1
    while not end.is_placed[node]:
        if node not in leads:
            return False
        node = leads[node]
    return True


def _num_untracked(run: MappingRun, info: StepInfo) -> int:
    """Frames in a row that are not tracked, the one of `info` included."""
    placed = [row for row, record in enumerate(run.records) if record.status in PLACED]
    return 0 if info.localization.is_tracked else len(run.records) - (placed[-1] if placed else -1)


def look_for(run: MappingRun, given: Input) -> tuple[Location | None, str | None]:
    """Relocalize the first frame of `given`: return its pose, or the reason why there is none; see `loops.location`."""
    return run.back_end.locate(looks_of(given)[0])


def looks_of(given: Input) -> list[Look]:
    """Collect what the back end needs of each frame."""
    return [
        Look(frame.index, frame.image, raw.points, raw.mask, given.T_anchor_views)
        for frame, raw in zip(given.frames, given.raw, strict=True)
    ]


def as_prediction(taken: FirstWindow | Prediction) -> Prediction:
    """The first view of a sequence as a step's current frame; what is one stays."""
    if isinstance(taken, Prediction):
        return taken
    view, T = jax.tree.map(lambda leaf: leaf[0], taken.views), pose_row(taken.T_world_views, 0)
    return Prediction(
        current=view,
        previous=view,
        T_world_views=_repeated(T, 3),
        T_world_anchor=T,
        has_newest=jnp.asarray(False),
        is_repeat=jnp.asarray(False),
    )


def begun(run: MappingRun, prediction: Prediction) -> SlamState:
    """A state in the saved map, of the form of any other: for one that is read from a checkpoint."""
    time = jnp.asarray(len(run.back_end.poses), jnp.int32)
    return SlamState(run.saved.map, prediction.current, prediction.T_world_anchor, certain(), time)


def found_at(
    run: MappingRun, prediction: Prediction, location: Location, has_other_unit: bool = False
) -> tuple[SlamState, Prediction]:
    """Return a state and prediction whose step starts at the relocalized pose: this frame is its own previous one.

    With `has_other_unit` the prior's lengths are no longer those of the steps before: this frame determines the unit.

    Raises:
        ValueError: the features of a saved map are not as wide as those of this run.
    """
    T, scale = to_se3(location.T_world_camera), jnp.exp(jnp.asarray(location.log_scale, jnp.float32))
    placed = moved(prediction, anchor_motion(prediction, T, scale))
    views = placed.T_world_views.wxyz_xyz[jnp.array([1, 1, 2])]
    again = replace(placed, previous=placed.current, T_world_views=jaxlie.SE3(views), is_repeat=jnp.asarray(False))
    covariance = jnp.asarray(location.covariance, jnp.float32)
    if run.state is None:
        map, time, saved = run.saved.map, len(run.saved.back_end.poses), run.saved
        widths = map.gaussians.features.shape[-1], prediction.current.features.shape[-1]
        if widths[0] != widths[1]:
            raise ValueError(
                f"the features of the saved map have width {widths[0]} and those of this run {widths[1]}: use prior= "
                "and features= that it was mapped with"
            )
        # The prior's unit in this map is what this frame says.
        depth_noise, log_scale = (jnp.asarray(x, jnp.float32) for x in (saved.depth_noise, location.log_scale))
        belief, time = replace(certain(), depth_noise=depth_noise, log_scale=log_scale), jnp.asarray(time, jnp.int32)
    else:
        map, belief, time = run.state.map, run.state.belief, run.state.time
        if has_other_unit:
            belief = replace(belief, log_scale=jnp.asarray(location.log_scale, jnp.float32))
    belief = replace(belief, covariance=covariance, world_covariance=covariance)
    return SlamState(map, transform(T, prediction.current, scale), T, belief, time), again


def anchor_motion(prediction: Prediction, T_world_camera: jaxlie.SE3, scale: jnp.ndarray) -> jaxlie.SE3:
    """Return the motion of the prior's world that brings its own current pose, scaled about the anchor, to this one."""
    anchor, current = prediction.T_world_anchor, pose_row(prediction.T_world_views, 1)
    return T_world_camera @ scale_translation(anchor.inverse() @ current, scale).inverse() @ anchor.inverse()


def anchored_by(record: FrameRecord, prediction: Prediction) -> jaxlie.SE3:
    """`anchor_motion` by a frame that was found."""
    return anchor_motion(prediction, to_se3(record.pose), jnp.asarray(record.scale, jnp.float32))


def moved(prediction: Prediction, motion: jaxlie.SE3 | None) -> Prediction:
    """The prediction in a world that has moved; the same where there is no motion."""
    if motion is None:
        return prediction
    views = [motion @ pose_row(prediction.T_world_views, row) for row in range(3)]
    views = jaxlie.SE3(jnp.stack([view.wxyz_xyz for view in views]))
    return replace(prediction, T_world_views=views, T_world_anchor=motion @ prediction.T_world_anchor)


def refusal(info: StepInfo, prediction: Prediction, location: Location, config: LocationConfig) -> str | None:
    """Return why the map rejects a relocalized pose (too few inliers, or they move it too far); None if it does not."""
    found, current = info.localization, prediction.current
    depth = np.median(np.asarray(current.points[:, 2])[np.asarray(current.valid)]) * np.exp(location.log_scale)
    agrees = bool(found.is_tracked) and float(found.icp.inlier_fraction) >= config.min_inlier_fraction
    stays = found.step_m <= config.max_step * depth and np.degrees(found.step_rad) <= config.max_step_deg
    return None if agrees and stays else FINE_POSE


def nowhere(run: MappingRun) -> str:
    """That no frame was found in the saved map, and why."""
    counts = Counter(record.location for record in run.records if record.location is not None)
    reasons = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    return (
        f"none of the {len(run.records)} frames is found in the saved map ({reasons or 'none has points and a pose'}): "
        "take images of the same place, or map it anew without map="
    )


def with_map(state: SlamState, map: GaussianMap, capacity: int) -> SlamState:
    """The state with the map as it was, with as much room as there is now."""
    room = grow(map, capacity) if capacity > map.weight.shape[0] else map
    return replace(state, map=room)


def _repeated(T: jaxlie.SE3, count: int) -> jaxlie.SE3:
    return jaxlie.SE3(jnp.stack([T.wxyz_xyz] * count))
