"""One input into an atlas: its frames are placed in a map and fused, and the pose graph closes loops."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import numpy as np

from emgs_jax.back_end.loops import (
    consistent_loops,
    detect_loops,
    is_closure_due,
    not_in_graph,
    query_prior,
    recent_loops,
    remove_inconsistent,
    violated,
)
from emgs_jax.back_end.optimization import close_loops, merge_duplicates_of_state, nodes_of
from emgs_jax.back_end.state import BackEnd, add_node
from emgs_jax.device.arrays import to_matrix, to_se3
from emgs_jax.device.clock import Clock, Timer
from emgs_jax.geometry import seen_from
from emgs_jax.loop_closure.prior_query import PriorQuery
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.atlas import (
    Atlas,
    Found,
    begin,
    camera_in_world,
    join_at,
    locate,
    return_to_world,
    with_state,
)
from emgs_jax.mapping.capacity import advance, prepare_step, restart_map
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.event import JOINED, NEW_SUBMAP, RELOCALIZED, RESTARTED, Event
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.mapping.world import anchor_world, move_prediction, step_prediction
from emgs_jax.observation import depth_in
from emgs_jax.slam import SlamState, StepInfo


def integrate(
    atlas: Atlas, window: WindowInput, query: PriorQuery = lambda a, b: None, clock: Clock | None = None
) -> tuple[Atlas, Event]:
    """Integrate one input: place its frames and fuse them, add them to the pose graph, close loops.

    Args:
        query: predicts both visits of a loop, see `prior_queries`.
    """
    clock = clock or Clock()
    timer = Timer(clock)
    atlas, event, found = place(atlas, window)
    event = replace(event, seconds=seconds_of(window, timer))
    atlas = replace(atlas, num_lost=0 if event.is_placed else atlas.num_lost + 1)
    with contextlib.nullcontext() if atlas.graph.config is None else clock.phase("back_end"):
        return update_graph(atlas, window, event, found, query), event


def seconds_of(window: WindowInput, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Add the seconds of the conversion to those of a timer, which `num_sharing` runs share equally."""
    return {name: window.seconds.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}


def place(atlas: Atlas, window: WindowInput) -> tuple[Atlas, Event, Found | None]:
    """Start a map or a submap from an input, or step with it: localize, fuse, refine, insert.

    Returns:
        The atlas, what became of the frames, and where they were found in another submap, which is joined then.
    """
    if window.prediction is None:
        return atlas, lost_event(atlas, window), None
    if isinstance(window.prediction, FirstWindow):
        prepare_step(window.prediction.views, atlas.camera, atlas.config)
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
    """Make the event of a frame that is in no map; its pose is the anchor's, or the saved map's last one."""
    nodes = atlas.graph.nodes
    return Event((nodes[-1].pose if nodes else window.T_world_anchor)[None], location=location)


def start_event(atlas: Atlas, window: WindowInput) -> Event:
    """Make the event of the frames that a map has started from; raise ValueError where that map is empty."""
    count = int(np.asarray(atlas.state.map.gaussians.valid).sum())
    if atlas.graph.active != 0:  # nothing says where it is
        return Event(atlas.graph.nodes[-1].pose[None], is_start=True, num_gaussians=count, location=NEW_SUBMAP)
    poses = np.asarray(window.prediction.T_world_views.wxyz_xyz)
    if count == 0:  # no later frame could be localised in it
        raise ValueError(
            f"the map is empty after {len(poses)} view(s) from {window.frames[0].name}: the prior has no valid "
            "point there; begin elsewhere (dataset.start=...) or use slam.initialization=merged"
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
    """Covariance (6, 6), seen from a pose, of the part of the map it was registered to, relative to the first frame.

    That part errs as a whole by what the frame erred that it was made of, the origin: on a way out errors add up from
    one origin to the next, and where a place is seen again they are what they were. A frame that nothing in the map
    explains has the origin of the frame before. A saved map is exact.
    """
    rows = (origin, *(node.origin for node in reversed(graph.nodes)))
    row = next((row for row in rows if row is not None and row < len(graph.nodes)), None)
    there = None if row is None else graph.nodes[row]
    if there is None or there.covariance is None:
        return np.zeros((6, 6))
    return seen_from(there.covariance, there.pose, pose[None])[0]


def _step(atlas: Atlas, window: WindowInput) -> tuple[Atlas, StepInfo | None]:
    """Run one step; nothing happens where the camera has no pose yet."""
    if atlas.state is None:
        return atlas, None
    prediction = move_prediction(step_prediction(atlas.world, window), atlas.world.motion)
    state, info, config = advance(atlas.state, prediction, atlas.camera, atlas.config)
    return with_state(atlas, state, config), info


def relocalize_lost(
    before: Atlas, after: Atlas, window: WindowInput, info: StepInfo | None
) -> tuple[Atlas, StepInfo | None, str | None]:
    """Relocalize a lost camera, and repeat its step at the pose found; restart the map where that fails for long.

    Args:
        after: the step, with the pose that it has estimated.

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

    Only after many untracked frames, and where the prior connects a frame in the map with this one and knows what it
    sees: there are points, and its two predictions of the previous image agree.

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


def _num_untracked(atlas: Atlas, info: StepInfo) -> int:
    """Count the last frames in a row that are not tracked, the one of `info` included."""
    return 0 if info.localization.is_tracked else atlas.num_lost + 1


def _found_in_other_submap(atlas: Atlas, window: WindowInput, event: Event) -> tuple[Event, Found | None]:
    """Find a tracked frame in an inactive submap; where that succeeds, it gets the similarity of both worlds.

    The relocalized pose must pass the tests of a lost camera's, the fit to the map included.
    """
    if len(atlas.submaps) < 2 or event.location is not None or not event.is_tracked:
        return event, None
    found = locate(atlas, window, in_other_submap=True)
    if not isinstance(found, Found):
        return event, None
    similarity = camera_in_world(found.after[1]) @ camera_in_world(event.info).inverse()
    return replace(event, location=JOINED, similarity=similarity.as_matrix()), found


def update_graph(
    atlas: Atlas, window: WindowInput, event: Event, found: Found | None = None, query: PriorQuery = lambda a, b: None
) -> Atlas:
    """Add frames to the pose graph, join submaps; detect and verify loops, optimize the poses and deform the map."""
    if atlas.state is None or atlas.is_frozen:
        return atlas
    atlas = replace(atlas, graph=add_frames(atlas.graph, window, event))
    if atlas.graph.config is None:
        return atlas
    if found is not None:
        atlas = join_at(atlas, window, event, found)
    graph, loops = verify_loops(atlas.graph, window, query)
    atlas = replace(atlas, graph=graph)
    return atlas if loops is None else optimize_and_deform(atlas, loops)


def add_frames(graph: BackEnd, window: WindowInput, event: Event) -> BackEnd:
    """Add the frames of an input to the pose graph; relocalized ones and new submaps are not connected."""
    is_step = event.is_tracked and not event.is_start
    for frame, pose in zip(window.data, event.poses, strict=True):
        if event.location in (RELOCALIZED, NEW_SUBMAP):
            graph = replace(graph, connected_since=len(graph.nodes))
        frame = replace(frame, depth_noise=event.depth_noise if is_step else None, covariance=event.covariance)
        graph = add_node(graph, frame, pose, event.scale or 1.0, event.origin, event.is_placed)
    return graph


def verify_loops(
    before: BackEnd, window: WindowInput, query: PriorQuery
) -> tuple[BackEnd, Sequence[LoopMeasurement] | None]:
    """Detect loops of the last frame, and verify those that the poses violate by the prior.

    Returns:
        The pose graph, and the loops to close now; None where no closure is due.
    """
    end = detect_loops(before, window.data[-1])
    loops = recent_loops(end)
    if is_closure_due(end, loops):
        end = query_prior(end, violated(end, loops), query)
        loops = recent_loops(end)
    kept = remove_inconsistent(end) if len(end.violating) > len(before.violating) else end
    is_due = len(kept.accepted) < len(end.accepted) or is_closure_due(kept, loops)
    return kept, loops if is_due else None


def optimize_and_deform(atlas: Atlas, loops: Sequence[LoopMeasurement]) -> Atlas:
    """Close loops: optimize the poses, and deform the map; the prior's world moves with the last frame."""
    before, motion = atlas.graph.nodes[-1].pose, atlas.world.motion
    graph, state = close_loops(atlas.graph, atlas.state, loops)
    if motion is not None:
        motion = to_se3(graph.nodes[-1].pose @ np.linalg.inv(before)) @ motion
    return with_state(replace(atlas, graph=graph, world=replace(atlas.world, motion=motion)), state, atlas.config)


def finish_back_end(atlas: Atlas, query: PriorQuery = lambda a, b: None) -> Atlas:
    """Optimize the poses once more, with all factors, and deform the map accordingly.

    Nothing changes where no loop violates, or has violated, the poses: frames and map fit each other better as first
    estimated. Else duplicate surfaces are merged that came to lie on each other and that nobody saw again.
    """
    end = atlas.graph
    end = query_prior(end, violated(end, not_in_graph(end, consistent_loops(end))), query)
    kept = remove_inconsistent(end)
    loops = violated(kept, not_in_graph(kept, consistent_loops(kept)))
    atlas = replace(atlas, graph=kept)
    if len(kept.accepted) < len(end.accepted) or kept.accepted or loops:
        atlas = optimize_and_deform(atlas, loops)
    end = atlas.graph
    noise = [node.depth_noise for node in end.nodes if node.is_placed and node.depth_noise is not None]
    if noise and (end.accepted or not end.has_one_unit):  # at the end only: what was made one Gaussian stays one
        nodes = nodes_of(end, end.active)
        state = merge_duplicates_of_state(atlas.state, nodes, float(np.median(noise)), atlas.config.existence)
        atlas = with_state(atlas, state, atlas.config)
    return atlas
