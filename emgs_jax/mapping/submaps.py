"""Disconnected submaps of a run, whose relative poses are not known until the camera sees both.

A prior that has lost the first view may continue in a world of its own. There a new map starts, and the one before
becomes inactive. Where a frame fits an inactive map, the similarity between its two poses joins both submaps: the newer
one moves, poses, scales and Gaussians. Submaps that are never joined are apart in the end.
"""

from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax.back_end.factors import Factor
from emgs_jax.back_end.loops import relocalize_frame
from emgs_jax.back_end.optimization import deform_state, move_map, nodes_of
from emgs_jax.back_end.state import BackEnd, transform_nodes
from emgs_jax.device.arrays import to_matrix, to_se3
from emgs_jax.geometry import Sim3, scale_covariance, scale_pose
from emgs_jax.loop_closure.relocalization import RelocalizedPose
from emgs_jax.mapping.capacity import add_map, advance, start
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.records import APART, IN_MAP, JOINED, UNJOINED, transform_record
from emgs_jax.mapping.relocalization import (
    anchor_motion_of,
    as_step_prediction,
    is_related,
    place_structure,
    rejection,
    relocalized_start,
    step_prediction,
)
from emgs_jax.mapping.run import LeftWorld, MappingRun, TrackedFrame, row_of_first_node
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.observation import no_covariance, unknown_scale
from emgs_jax.registration.pose_estimate import rescale_estimate
from emgs_jax.slam import StepInfo


def start_submap(run: MappingRun, window: WindowInput) -> MappingRun | None:
    """Start a map of this frame alone, at the pose of the frame before; None where no submap starts.

    Its unit is the prior's own: that of another map does not apply. The map before it becomes inactive.
    """
    pose = window.T_anchor_views.get(window.frames[0].index)
    is_new = run.back_end is not None and run.state is not None and not run.is_fixed and not is_related(run, window)
    if not is_new or pose is None or not np.isfinite(pose).all():
        return None
    view = jax.tree.map(lambda leaf: leaf[None], as_step_prediction(window.prediction).current)
    first = FirstWindow(view, to_se3(run.records[-1].pose[None]), no_covariance()[None], unknown_scale()[None])
    alone, config = start(first, run.camera, run.config)
    if not bool(alone.map.gaussians.valid.any()):
        return None
    time = run.state.time
    map = replace(alone.map, birth=jnp.full_like(alone.map.birth, time))
    return replace(enter_submap(run, window), state=replace(alone, map=map, time=time + 1), config=config)


def enter_submap(run: MappingRun, window: WindowInput) -> MappingRun:
    """Switch to the submap that this frame starts; the state before it becomes inactive."""
    return replace(
        run,
        inactive={**run.inactive, run.back_end.submap_id: run.state},
        worlds=_with_world_left(run),
        back_end=replace(run.back_end, submap_id=window.structure),
        structure=place_structure(window, run.records[-1].pose),
        prior_motion=None,
    )


def _with_world_left(run: MappingRun) -> dict[int, LeftWorld]:
    number = 0 if run.structure is None else run.structure.number
    return {**run.worlds, number: LeftWorld(run.structure, run.prior_motion, run.back_end.submap_id)}


def return_to_world(run: MappingRun, window: WindowInput) -> MappingRun:
    """Switch to the world of this frame where the run has been in it before, and to its submap.

    Nothing of the frame before is known there: the step starts at the pose that the prior predicts.
    """
    before = run.worlds.get(window.structure)
    if before is None or run.back_end is None or run.state is None or is_related(run, window):
        return run
    states = {**run.inactive, run.back_end.submap_id: run.state}
    if before.submap_id not in states:
        return run
    state = states.pop(before.submap_id)
    previous = replace(state.previous, valid=jnp.zeros_like(state.previous.valid))
    return replace(
        run,
        state=replace(state, previous=previous, time=run.state.time),
        inactive=states,
        worlds=_with_world_left(run),
        back_end=replace(run.back_end, submap_id=before.submap_id),
        structure=before.structure,
        prior_motion=before.prior_motion,
    )


def match_submap(run: MappingRun, window: WindowInput, frame: TrackedFrame) -> TrackedFrame:
    """Relocalize a tracked frame in an inactive submap; where that succeeds, it gets the similarity of both worlds.

    The relocalized pose must pass the tests of a lost camera's, the fit to the map included.

    Args:
        run: after the step of this frame, before its record.
        frame: of that step, in its own submap.
    """
    if not run.inactive or frame.location is not None or not bool(frame.info.localization.is_tracked):
        return frame
    place, _ = relocalize_frame(run.back_end, window.data[0], in_other_submap=True)
    if place is None:
        return frame
    other = run.inactive[run.back_end.nodes[place.keyframe].submap]
    # This frame determines the prior's unit in that map.
    estimate = replace(other.estimate, log_scale=jnp.asarray(place.log_scale, jnp.float32))
    visiting = replace(run, state=replace(other, estimate=estimate))
    begin, again = relocalized_start(visiting, frame.prediction, place)
    _, there, _ = advance(begin, again, run.camera, run.config)
    if rejection(there, again, place, run.back_end.config.relocalization) is not None:
        return frame
    similarity = _camera_in_world(there) @ _camera_in_world(frame.info).inverse()
    return replace(frame, location=JOINED, similarity=similarity.as_matrix())


def _camera_in_world(info: StepInfo) -> Sim3:
    """Similarity from a camera's frame, in the unit of its prediction, to the world."""
    T = to_matrix(np.asarray(info.T_world_camera.wxyz_xyz))
    return Sim3(float(info.localization.scale), T[:3, :3], T[:3, 3])


def join_submaps(run: MappingRun, window: WindowInput) -> MappingRun:
    """Join the submap of the last frame, which is a node already, with the one in which it was relocalized.

    The newer one moves, by the similarity of the record or its inverse.
    """
    end, similarity = run.back_end, Sim3.from_matrix(run.records[-1].similarity)
    place, _ = relocalize_frame(end, window.data[-1], in_other_submap=True)  # where `match_submap` has found it
    here, there = end.submap_id, end.nodes[place.keyframe].submap
    if here < there:
        similarity = similarity.inverse()
    newer, older, before = max(here, there), min(here, there), nodes_of(end)
    unit = np.exp(end.nodes[place.keyframe].log_scale)  # of the place's covariance: its map may be the one that moves
    rows = [row for row, node in enumerate(end.nodes) if node.submap == newer]
    end = transform_nodes(end, rows, similarity)
    after, first = nodes_of(end), row_of_first_node(run) - end.first_node
    records = list(run.records)
    for row in rows:
        records[first + row] = transform_record(records[first + row], similarity)
    nodes = tuple(replace(node, submap=older) if node.submap == newer else node for node in end.nodes)
    factors = [*end.factors, join_factor(end, place, unit)]
    end = replace(end, nodes=nodes, submap_id=older, has_one_unit=False, factors=factors)
    other = run.inactive[there]
    state = deform_state(run.state, before, after, end.min_std, end.config.deform)
    moved = move_map(other.map, before, after, jnp.asarray(end.min_std, jnp.float32), end.config.deform)
    map, config = add_map(state.map, moved, run.config)
    state, motion = replace(state, map=map), run.prior_motion
    if here == newer:
        scale = jnp.asarray(similarity.scale, jnp.float32)
        state = replace(state, estimate=rescale_estimate(state.estimate, scale))
        motion = anchor_motion_of(records[-1], step_prediction(run, window))
    inactive = {one: state for one, state in run.inactive.items() if one != there}
    # Where another world of the prior lies in a submap that moves is not known any more.
    worlds = {number: left for number, left in run.worlds.items() if left.submap_id != newer}
    run = replace(run, worlds=worlds)
    changed = {"state": state, "config": config, "records": tuple(records), "inactive": inactive}
    return replace(run, back_end=end, prior_motion=motion, **changed)


def join_factor(end: BackEnd, place: RelocalizedPose, unit: float) -> Factor:
    """Build the join factor of two submaps: the last node relative to the keyframe that relocalized it, as now.

    `unit` is a length of that keyframe's inference in the map in which the pose was found.
    """
    a, b = place.keyframe, len(end.nodes) - 1
    here, there = end.nodes[a], end.nodes[b]
    scale = np.exp(here.log_scale)
    information = np.linalg.inv(scale_covariance(place.covariance, 1.0 / unit))
    measured = scale_pose(np.linalg.inv(here.pose) @ there.pose, 1.0 / scale)
    ratio = there.log_scale - here.log_scale
    return Factor(a, b, measured, ratio, np.linalg.cholesky(information).T, is_loop=False)


def set_unjoined_apart(run: MappingRun) -> MappingRun:
    """Make the submap of most placed frames, or the saved map's, the run's map; the others stay as they are, apart."""
    if not run.inactive:
        return run
    end = run.back_end
    counts = Counter(node.submap for node in end.nodes if node.is_placed)
    kept = 0 if run.saved is not None else max(sorted(counts), key=lambda one: counts[one])
    is_kept = [node.submap == kept for node in end.nodes]
    between = {
        name: [one for one in getattr(end, name) if is_kept[one.a] and is_kept[one.b]]
        for name in ("factors", "verified", "violating", "accepted")
    }
    known = end.database
    rows = [row for row, one in enumerate(known.keyframes) if is_kept[one.frame]]
    end = replace(
        end,
        nodes=tuple(replace(node, is_placed=node.is_placed and node.submap == kept) for node in end.nodes),
        submap_id=kept,
        database=replace(known, keyframes=tuple(known.keyframes[row] for row in rows), vectors=known.vectors[rows]),
        **between,
    )
    first, records = row_of_first_node(run) - end.first_node, list(run.records)
    for row in range(end.first_node, len(is_kept)):
        if not is_kept[row]:
            record = records[first + row]
            status = APART if record.status in IN_MAP else "lost"
            known = {"submap": end.nodes[row].submap, "covariance": record.covariance if status == APART else None}
            records[first + row] = replace(record, status=status, reason=UNJOINED, **known)
    states = {run.back_end.submap_id: run.state, **run.inactive}
    state = states.pop(kept)
    return replace(run, state=state, inactive={}, apart=states, back_end=end, records=tuple(records))
