"""Integrate an input into an atlas: place its frames in a map, fuse them, and close loops."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

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
from emgs_jax.back_end.optimization import close_loops, follow_prior, merge_duplicates_of_state
from emgs_jax.back_end.state import BackEnd, add_node
from emgs_jax.device.arrays import to_matrix, to_se3
from emgs_jax.device.clock import Clock, Timer
from emgs_jax.geometry import Sim3
from emgs_jax.loop_closure.prior_query import PriorQuery
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.atlas import Atlas, World, join_at, with_state
from emgs_jax.mapping.event import NEW_SUBMAP, RELOCALIZED, Event
from emgs_jax.mapping.finalize import end_looks_of
from emgs_jax.mapping.tracking import Found, anchor_world, place
from emgs_jax.mapping.window_input import WindowInput


def integrate(
    atlas: Atlas, window: WindowInput, query: PriorQuery = lambda a, b: None, clock: Clock | None = None
) -> tuple[Atlas, Event]:
    """Integrate one input: place its frames and fuse them, add them to the pose graph, close loops.

    Args:
        query: predicts both visits of a loop, see `prior_queries`.
    """
    clock = clock or Clock()
    timer = Timer(clock)
    if window.adjusted and can_follow(atlas):
        with clock.phase("back_end"):
            T_world_anchor = anchor_in_map(atlas.world, window)
            graph, state = follow_prior(atlas.graph, atlas.state, window.adjusted, T_world_anchor)
        atlas = with_state(replace(atlas, graph=graph), state, atlas.config)
    atlas, event, found = place(atlas, window)
    event = replace(event, seconds=seconds_of(window, timer))
    atlas = replace(atlas, num_lost=0 if event.is_placed else atlas.num_lost + 1)
    if found is not None and not atlas.is_frozen:  # its last frames have none after them once it is joined
        atlas, seen = end_looks_of(atlas, found.submap)
        event = replace(event, seen=seen)
    with contextlib.nullcontext() if atlas.graph.config is None else clock.phase("back_end"):
        return update_graph(atlas, window, event, found, query), event


def can_follow(atlas: Atlas) -> bool:
    """Test whether the active submap lies in the prior's first world, and a back end moves it."""
    is_there = atlas.state is not None and not atlas.is_frozen and atlas.graph.config is not None
    return is_there and atlas.world.number == 0


def anchor_in_map(world: World, window: WindowInput) -> np.ndarray:
    """T_world_anchor (4, 4) of the prior's first world, as relocalization has moved it."""
    motion = np.eye(4) if world.motion is None else to_matrix(world.motion.wxyz_xyz)
    return motion @ window.T_world_anchor


def seconds_of(window: WindowInput, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Add the seconds of conversion to those of a timer, which `num_sharing` runs share equally."""
    return {name: window.seconds.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}


def update_graph(
    atlas: Atlas, window: WindowInput, event: Event, found: Found | None = None, query: PriorQuery = lambda a, b: None
) -> Atlas:
    """Add frames to the pose graph, join submaps, detect and verify loops, optimize the poses and deform the map."""
    if atlas.state is None or atlas.is_frozen:
        return atlas
    atlas = replace(atlas, graph=add_frames(atlas.graph, window, event))
    if atlas.graph.config is None:
        return atlas
    if found is not None:
        atlas = join_submaps(atlas, window, event, found)
    graph, loops = verify_loops(atlas.graph, window, query)
    atlas = replace(atlas, graph=graph)
    return atlas if loops is None else optimize_and_deform(atlas, loops)


def join_submaps(atlas: Atlas, window: WindowInput, event: Event, found: Found) -> Atlas:
    """Join the active submap, in which this frame is, with the other one in which it was relocalized."""
    similarity, before = Sim3.from_matrix(event.similarity), atlas.graph.active
    atlas = join_at(atlas, similarity, found.place)
    if atlas.graph.active == before:
        return atlas
    pose, scale = atlas.graph.nodes[-1].pose, similarity.scale * event.scale  # this frame and its world have moved
    return replace(atlas, world=anchor_world(atlas.world, window, pose, scale))


def add_frames(graph: BackEnd, window: WindowInput, event: Event) -> BackEnd:
    """Add an input's frames to the pose graph; relocalized frames and new submaps are not connected to earlier ones."""
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
    """Detect loops of the last frame, and query the prior for those that violate the poses.

    Returns:
        The pose graph, and the loops to close now; None if no closure is due.
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
    """Close loops: optimize the poses and deform the map; the prior's world moves with the last frame."""
    before, motion = atlas.graph.nodes[-1].pose, atlas.world.motion
    graph, state = close_loops(atlas.graph, atlas.state, loops)
    if motion is not None:
        motion = to_se3(graph.nodes[-1].pose @ np.linalg.inv(before)) @ motion
    return with_state(replace(atlas, graph=graph, world=replace(atlas.world, motion=motion)), state, atlas.config)


def finish_back_end(atlas: Atlas, query: PriorQuery = lambda a, b: None) -> Atlas:
    """Optimize the poses once more, with all factors, and deform the map accordingly.

    If no loop violates, or has violated, the poses, nothing changes: frames and map fit each other better as first
    estimated. Otherwise also merge duplicate surfaces that came to lie on each other and that no later frame saw.
    """
    end = atlas.graph
    end = query_prior(end, violated(end, not_in_graph(end, consistent_loops(end))), query)
    kept = remove_inconsistent(end)
    loops = violated(kept, not_in_graph(kept, consistent_loops(kept)))
    atlas = replace(atlas, graph=kept)
    if len(kept.accepted) < len(end.accepted) or kept.accepted or loops:
        atlas = optimize_and_deform(atlas, loops)
    end = atlas.graph
    if end.accepted or not end.has_one_unit:  # only at the end: merged Gaussians stay merged
        state = merge_duplicates_of_state(atlas.state, end, atlas.config.existence)
        atlas = with_state(atlas, state, atlas.config)
    return atlas
