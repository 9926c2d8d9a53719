"""Place an input: start a map from it, track it in the active submap, or relocalize it in one by keyframes.

A prior that has lost the first view may continue in a world of its own; relocalizing a frame places that world.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.back_end.loops import relocalize_frame
from emgs_jax.back_end.state import BackEnd
from emgs_jax.device.arrays import to_matrix, to_se3
from emgs_jax.geometry import Sim3, seen_from
from emgs_jax.loop_closure.relocalization import NO_CANDIDATE, RelocalizationConfig, RelocalizedPose
from emgs_jax.mapping.atlas import Atlas, World, with_state
from emgs_jax.mapping.capacity import advance, restart_map, start
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.event import JOINED, NEW_SUBMAP, RELOCALIZED, RESTARTED, Event
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.motion import looks_from
from emgs_jax.observation import Prediction, depth_in, no_covariance, transform, unknown_scale
from emgs_jax.registration.rigid import pose_row, scale_translation
from emgs_jax.slam import SlamConfig, SlamState, StepInfo

FINE_POSE = "fine_pose"  # reason of a rejection: the frame does not fit the map at the relocalized pose
UNKNOWN = np.full((4, 4), np.nan)  # pose


@dataclass(frozen=True)
class Found:
    """A frame that was relocalized in a submap, perhaps the active one.

    Args:
        place: pose by keyframes.
        after: the submap's state, the result of the step that starts there, and config.
    """

    submap: int
    place: RelocalizedPose
    after: tuple[SlamState, StepInfo, SlamConfig]


def place(atlas: Atlas, window: WindowInput) -> tuple[Atlas, Event, Found | None]:
    """Start a map or a submap from an input, or step with it: localize, fuse, refine, insert.

    Returns:
        The atlas, the outcome of the frames, and the frame's place in another submap, if it is to be joined.
    """
    if window.prediction is None:
        return atlas, lost_event(atlas, window), None
    atlas = return_to_world(atlas, window)
    started = begin(atlas, window)
    if started is not None:
        return started, start_event(started, window), None
    after, info = _step(atlas, window)
    after, info, location = relocalize_lost(atlas, after, window, info)
    if info is None:
        return atlas, lost_event(atlas, window, location), None
    event = step_event(after, info, location)
    if location == RELOCALIZED:
        after = replace(after, world=anchor_world(after.world, window, event.poses[0], event.scale))
    return after, *_found_in_other_submap(after, window, event)


def lost_event(atlas: Atlas, window: WindowInput, location: str | None = None) -> Event:
    """Make the event of a frame that is in no map; its pose is the anchor's, or the last one of the saved map."""
    nodes = atlas.graph.nodes
    return Event((nodes[-1].pose if nodes else window.T_world_anchor)[None], location=location)


def start_event(atlas: Atlas, window: WindowInput) -> Event:
    """Make the event of the frames from which a map started; raise ValueError if that map is empty."""
    count = int(np.asarray(atlas.state.map.gaussians.valid).sum())
    if atlas.graph.active != 0:  # its place is unknown
        return Event(atlas.graph.nodes[-1].pose[None], is_start=True, num_gaussians=count, location=NEW_SUBMAP)
    poses = np.asarray(window.prediction.T_world_views.wxyz_xyz)
    if count == 0:  # no later frame could be localized in it
        num_points = int(np.asarray(window.prediction.views.valid).sum())
        raise ValueError(
            f"the map is empty after {len(poses)} view(s) from {window.frames[0].name}: of {num_points} valid points "
            "none become a Gaussian; begin elsewhere (dataset.start=...), use slam.initialization=merged, or make "
            f"smaller Gaussians (slam.fit.points_per_gaussian={atlas.config.fit.points_per_gaussian} here)"
        )
    return Event(np.stack([to_matrix(pose) for pose in poses]), is_start=True, num_gaussians=count)


def step_event(atlas: Atlas, info: StepInfo, location: str | None = None) -> Event:
    """Make the event of a step; `info` is fetched to the host."""
    info = jax.device_get(info)
    is_start, pose = location == RESTARTED, to_matrix(info.T_world_camera.wxyz_xyz)
    is_counted = is_start or atlas.is_frozen
    count = int(np.asarray(atlas.state.map.gaussians.valid).sum()) if is_counted else int(info.num_gaussians)
    event = Event(pose[None], is_start, count, atlas.is_frozen, info, location)
    of_step, by_map = np.asarray(info.localization.estimate.covariance, np.float64)[:-1, :-1], info.localization.by_map
    covariance = of_step + by_map @ covariance_of_map(atlas.graph, pose, event.origin) @ by_map.T
    return replace(event, covariance=covariance)


def covariance_of_map(graph: BackEnd, pose: np.ndarray, origin: int | None) -> np.ndarray:
    """Compute the covariance (6, 6) of the part of the map that a pose was registered to, relative to the first frame.

    It is expressed in the axes of the pose. That part has the error of the frame that made it, the origin. Along a walk
    errors add up from one origin to the next; at a place that is seen again they are as before. A frame that nothing in
    the map explains takes the origin of the previous frame. A saved map counts as exact.
    """
    rows = (origin, *(node.origin for node in reversed(graph.nodes)))
    row = next((row for row in rows if row is not None and row < len(graph.nodes)), None)
    there = None if row is None else graph.nodes[row]
    if there is None or there.covariance is None:
        return np.zeros((6, 6))
    return seen_from(there.covariance, there.pose, pose[None])[0]


def is_related(world: World, window: WindowInput) -> bool:
    """Test whether the predicted poses are in this world."""
    return window.world == world.number


def place_world(window: WindowInput, pose: np.ndarray) -> World:
    """Place the world of an input by its frame's pose in the map; lengths are scaled about that frame."""
    own = window.T_anchor_views.get(window.frames[0].index, UNKNOWN)
    return World(window.world, pose @ np.linalg.inv(own), pose)


def anchor_world(world: World, window: WindowInput, pose: np.ndarray, scale: float) -> World:
    """Anchor the prior's world at a relocalized frame, by its pose and scale."""
    if not is_related(world, window):  # the prior continues in a world of its own, which moves with this frame
        return replace(place_world(window, pose), motion=jaxlie.SE3.identity())
    prediction = step_prediction(world, window)
    return replace(world, motion=anchor_motion(prediction, to_se3(pose), jnp.asarray(scale, jnp.float32)))


def step_prediction(world: World, window: WindowInput) -> Prediction:
    """Return a step's prediction in the world of the map; without poses if they are not related to it."""
    prediction = as_step_prediction(window.prediction)
    if world.T_world_prior is None or not is_related(world, window):
        return prediction
    here = window.frames[0].index
    rows = here - 1, here, here + int(prediction.has_newest)
    T_world_views = world.T_world_prior @ np.stack([window.T_anchor_views.get(row, UNKNOWN) for row in rows])
    return replace(prediction, T_world_views=to_se3(T_world_views), T_world_anchor=to_se3(world.T_world_anchor))


def as_step_prediction(opening: FirstWindow | Prediction) -> Prediction:
    """Convert the first view of a sequence to a step's input; return the input of a step unchanged."""
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


def anchor_motion(prediction: Prediction, T_world_camera: jaxlie.SE3, scale: jnp.ndarray) -> jaxlie.SE3:
    """Return the motion of the prior's world that takes its own current pose, scaled about the anchor, to this one."""
    anchor, current = prediction.T_world_anchor, pose_row(prediction.T_world_views, 1)
    return T_world_camera @ scale_translation(anchor.inverse() @ current, scale).inverse() @ anchor.inverse()


def move_prediction(prediction: Prediction, motion: jaxlie.SE3 | None) -> Prediction:
    """Apply a motion of the prior's world to a prediction; None changes nothing.

    The motion comes from relocalization, so the prior's uncertainty in its own world says little about poses here.
    """
    if motion is None:
        return prediction
    views = [motion @ pose_row(prediction.T_world_views, row) for row in range(3)]
    views = jaxlie.SE3(jnp.stack([view.wxyz_xyz for view in views]))
    unknown = jnp.full_like(prediction.pose_covariance, jnp.nan)
    anchor = motion @ prediction.T_world_anchor
    return replace(prediction, T_world_views=views, T_world_anchor=anchor, pose_covariance=unknown)


def begin(atlas: Atlas, window: WindowInput) -> Atlas | None:
    """Start the first map, or a submap from this frame alone if the prior's world is not related to any known one.

    A submap starts at the pose of the previous frame, in the prior's own unit, because that of another map does not
    apply. Returns None if none starts.
    """
    if not atlas.submaps:
        return with_state(atlas, *start(window.prediction, atlas.camera, atlas.config))
    pose, graph, before = window.T_anchor_views.get(window.frames[0].index), atlas.graph, atlas.state
    is_new = graph.config is not None and before is not None and not atlas.is_frozen
    if not is_new or is_related(atlas.world, window) or pose is None or not np.isfinite(pose).all():
        return None
    last = graph.nodes[-1].pose
    view = jax.tree.map(lambda leaf: leaf[None], as_step_prediction(window.prediction).current)
    first = FirstWindow(view, to_se3(last[None]), no_covariance()[None], unknown_scale()[None])
    alone, config = start(first, atlas.camera, atlas.config)
    if not bool(alone.map.gaussians.valid.any()):
        return None
    map = replace(alone.map, birth=jnp.full_like(alone.map.birth, before.time))
    atlas = _with_world_left(atlas)
    atlas = replace(atlas, graph=replace(graph, active=max(atlas.submaps) + 1), world=place_world(window, last))
    looks = alone.looks
    if looks is not None:  # those of this frame; the others have not been
        looks = replace(looks, time=jnp.where(looks.time < 0, looks.time, looks.time + before.time))
    return with_state(atlas, replace(alone, map=map, time=before.time + 1, looks=looks), config)


def _with_world_left(atlas: Atlas) -> Atlas:
    """Remember in the active submap the place of the prior's world that the run leaves."""
    left = replace(atlas.active, worlds={**atlas.active.worlds, atlas.world.number: atlas.world})
    return replace(atlas, submaps={**atlas.submaps, atlas.graph.active: left})


def return_to_world(atlas: Atlas, window: WindowInput) -> Atlas:
    """Switch to the world of this frame, and to its submap, if the run has been in it before.

    Nothing is known there about the previous frame, so the step starts at the pose that the prior predicts.
    """
    known = (number for number, submap in atlas.submaps.items() if window.world in submap.worlds)
    number = None if atlas.state is None or is_related(atlas.world, window) else next(known, None)
    if number is None:
        return atlas
    submap, time = atlas.submaps[number], atlas.state.time
    previous = replace(submap.state.previous, valid=jnp.zeros_like(submap.state.previous.valid))
    atlas = replace(_with_world_left(atlas), graph=replace(atlas.graph, active=number))
    atlas = replace(atlas, world=submap.worlds[window.world])
    return with_state(atlas, replace(atlas.state, previous=previous, time=time), atlas.config)


def _step(atlas: Atlas, window: WindowInput) -> tuple[Atlas, StepInfo | None]:
    """Run one step; do nothing if the camera has no pose yet."""
    if atlas.state is None:
        return atlas, None
    prediction = move_prediction(step_prediction(atlas.world, window), atlas.world.motion)
    state, info, config = advance(atlas.state, prediction, atlas.camera, atlas.config)
    return with_state(atlas, state, config), info


def relocalize_lost(
    before: Atlas, after: Atlas, window: WindowInput, info: StepInfo | None
) -> tuple[Atlas, StepInfo | None, str | None]:
    """Relocalize a lost camera and repeat its step at that pose; restart the map if this fails for long.

    Args:
        after: result of the step, with the pose that it estimated.

    Returns:
        The atlas, the step's result, and the outcome of relocalization.
    """
    if not is_relocalization_due(before, info):
        return after, info, None
    found = locate(before, window)
    if isinstance(found, Found):
        state, info, config = found.after
        there = replace(before, graph=replace(before.graph, active=found.submap))
        return with_state(there, state, config), info, RELOCALIZED
    if info is None or not is_restart_due(before, window, after.state, info):
        return after, info, found
    return with_state(after, *restart_map(after.state, after.camera, after.config)), info, RESTARTED


def is_relocalization_due(atlas: Atlas, info: StepInfo | None) -> bool:
    """Test whether relocalization is due: no pose is known yet, or no frame has been tracked for a while."""
    if atlas.graph.config is None or not atlas.submaps:
        return False
    return info is None or _num_untracked(atlas, info) >= atlas.graph.config.relocalization.patience


def is_restart_due(atlas: Atlas, window: WindowInput, state: SlamState, info: StepInfo) -> bool:
    """Test whether the map restarts from a frame that was not relocalized, at the pose that the prior predicts.

    It does so only after many untracked frames, and only if the prior connects a frame in the map with this one and its
    geometry is plausible: there are points, and its two predictions of the previous image agree.

    Args:
        atlas: before this frame.
        state: after its step.
    """
    count = _num_untracked(atlas, info)
    is_due = not atlas.is_frozen and count >= atlas.graph.config.relocalization.max_patience
    if not is_due or not np.any(state.previous.valid) or not _is_connected(atlas.graph, window):
        return False
    depths = np.asarray(depth_in(state.T_world_previous, state.previous))
    depth = np.median(depths[np.asarray(state.previous.valid)])
    return bool(info.localization.repeat_rms <= atlas.config.localization.max_residual * depth)


def _is_connected(end: BackEnd, window: WindowInput) -> bool:
    """Test whether a chain of predictions, each of two consecutive frames, connects the map with the given frame.

    Frames that the prior itself lost are skipped if a later prediction has frames on both sides. The anchor does not
    count as a link, because a prior that lost the connection also predicts a pose of the anchor.
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


def _num_untracked(atlas: Atlas, info: StepInfo) -> int:
    """Count the last frames in a row that are not tracked, the one of `info` included."""
    return 0 if info.localization.is_tracked else atlas.num_lost + 1


def locate(atlas: Atlas, window: WindowInput, in_other_submap: bool = False) -> Found | str:
    """Relocalize a frame in a submap: by keyframes, then by a step from that pose; or return why this fails.

    Args:
        in_other_submap: search the other submap with the most similar keyframe, with a free ratio of units; otherwise
            the submap where the camera is, which at first is the saved map.
    """
    graph = atlas.graph
    place, failure = relocalize_frame(graph, window.data[0], in_other_submap)
    if place is None:
        return failure or NO_CANDIDATE
    number, is_known = graph.nodes[place.keyframe].submap, is_related(atlas.world, window)
    world = atlas.world if is_known else place_world(window, place.T_world_camera)
    is_same_unit = number == graph.active and is_known
    prediction, state = step_prediction(world, window), atlas.submaps[number].state
    begun, again = relocalized_start(state, prediction, place, is_same_unit)
    begun, info, config = advance(begun, again, atlas.camera, atlas.config)
    failure = rejection(info, again, place, graph.config.relocalization)
    return failure or Found(number, place, (begun, info, config))


def relocalized_start(
    state: SlamState, prediction: Prediction, place: RelocalizedPose, is_same_unit: bool = True
) -> tuple[SlamState, Prediction]:
    """Return a state and prediction whose step starts at the relocalized pose: this frame is its own previous one.

    Without `is_same_unit`, this frame determines the prior's unit: in another map, or if the prior's lengths are no
    longer those of earlier steps.

    Raises:
        ValueError: the features of a saved map and of this run differ in width.
    """
    widths = state.map.gaussians.features.shape[-1], prediction.current.features.shape[-1]
    if widths[0] != widths[1]:
        raise ValueError(
            f"the features of the saved map have width {widths[0]} and those of this run {widths[1]}: use prior= and "
            "features= that it was mapped with"
        )
    T, scale = to_se3(place.T_world_camera), jnp.exp(jnp.asarray(place.log_scale, jnp.float32))
    placed = move_prediction(prediction, anchor_motion(prediction, T, scale))
    views = placed.T_world_views.wxyz_xyz[jnp.array([1, 1, 2])]
    again = replace(placed, previous=placed.current, T_world_views=jaxlie.SE3(views), is_repeat=jnp.asarray(False))
    covariance, log_scale = (jnp.asarray(x, jnp.float32) for x in (place.covariance, place.log_scale))
    estimate = replace(state.estimate, covariance=covariance)
    if not is_same_unit:
        estimate = replace(estimate, log_scale=log_scale)
    looks = state.looks
    if looks is not None:
        looks = looks_from(looks, T.inverse() @ state.T_world_previous)
    previous = transform(T, prediction.current, scale)
    return replace(state, previous=previous, T_world_previous=T, estimate=estimate, looks=looks), again


def rejection(
    info: StepInfo, prediction: Prediction, place: RelocalizedPose, config: RelocalizationConfig
) -> str | None:
    """Return why the map rejects a relocalized pose (too few inliers, or too large a step); None if it accepts it."""
    found, current = info.localization, prediction.current
    depth = np.median(np.asarray(current.points[:, 2])[np.asarray(current.valid)]) * np.exp(place.log_scale)
    agrees = bool(found.is_tracked) and float(found.icp.inlier_fraction) >= config.min_inlier_fraction
    stays = found.step_m <= config.max_step * depth and np.degrees(found.step_rad) <= config.max_step_deg
    return None if agrees and stays else FINE_POSE


def _found_in_other_submap(atlas: Atlas, window: WindowInput, event: Event) -> tuple[Event, Found | None]:
    """Relocalize a tracked frame in an inactive submap; if that succeeds, its event gets the similarity of both worlds.

    The relocalized pose must pass the same tests as a lost camera's, including the fit to the map.
    """
    if len(atlas.submaps) < 2 or event.location is not None or not event.is_tracked:
        return event, None
    found = locate(atlas, window, in_other_submap=True)
    if not isinstance(found, Found):
        return event, None
    similarity = camera_in_world(found.after[1]) @ camera_in_world(event.info).inverse()
    return replace(event, location=JOINED, similarity=similarity.as_matrix()), found


def camera_in_world(info: StepInfo) -> Sim3:
    """Make the similarity from a camera's frame, in the unit of its prediction, to the world."""
    T = to_matrix(np.asarray(info.T_world_camera.wxyz_xyz))
    return Sim3(float(info.localization.scale), T[:3, :3], T[:3, 3])
