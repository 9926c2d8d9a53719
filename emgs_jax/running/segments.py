"""Segments: disconnected submaps of a run, whose relative poses are not known until the camera sees both.

A prior that has lost the first view may continue in a frame of its own. There a new map starts, and the one before is
set aside. Where a frame fits a map that is set aside, the similarity between its two poses joins both segments: the
newer one moves, poses, scales and Gaussians. Segments that are never joined are left out at the end.
"""

from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax.graph.measurements import ODOMETRY
from emgs_jax.loops.location import Location
from emgs_jax.loops.two_views import rescaled
from emgs_jax.observation import Prediction
from emgs_jax.registration.belief import rescaled_belief
from emgs_jax.running.back_end import BackEnd
from emgs_jax.running.convert import FirstWindow, to_se3
from emgs_jax.running.following import follow, move_map
from emgs_jax.running.growth import advance, start, with_part
from emgs_jax.running.inputs import Input, PlacedStructure
from emgs_jax.running.locating import anchored_by, as_prediction, found_at, looks_of, refusal
from emgs_jax.running.measuring import Edge
from emgs_jax.running.record import UNJOINED, FrameRecord, MappingRun, row_of_first_node, to_matrix
from emgs_jax.slam import SlamConfig, SlamState, StepInfo

UNKNOWN = np.full((4, 4), np.nan)  # pose


def predicted(run: MappingRun, given: Input) -> Prediction:
    """Return a step's prediction in the world of the map; without poses where they are not related to it."""
    prediction = as_prediction(given.taken)
    if run.structure is None or not is_related(run, given):
        return prediction
    return in_structure(prediction, given, run.structure)


def in_structure(prediction: Prediction, given: Input, placed: PlacedStructure) -> Prediction:
    """A step's input with the poses that are given in a frame of the prior's own, where that frame is placed."""
    here = given.frames[0].index
    rows = here - 1, here, here + int(prediction.has_newest)
    T_world_views = placed.T_world_structure @ np.stack([given.T_anchor_views.get(row, UNKNOWN) for row in rows])
    return replace(prediction, T_world_views=to_se3(T_world_views), T_world_anchor=to_se3(placed.T_world_anchor))


def is_related(run: MappingRun, given: Input) -> bool:
    """Test whether the given poses are in a frame whose pose in the map is known."""
    return given.structure == (0 if run.structure is None else run.structure.number)


def placed_by(given: Input, pose: np.ndarray) -> PlacedStructure:
    """Place the prior's own frame by the pose of the given frame in the world; lengths are scaled about that frame."""
    own = given.T_anchor_views.get(given.frames[0].index, UNKNOWN)
    return PlacedStructure(given.structure, pose @ np.linalg.inv(own), pose)


def begun_segment(run: MappingRun, given: Input) -> tuple[SlamState, SlamConfig] | None:
    """Start a map of this frame alone, at the pose of the frame before; None where no segment starts.

    Its unit is the prior's own: that of another map does not apply.
    """
    pose = given.T_anchor_views.get(given.frames[0].index)
    is_new = run.back_end is not None and run.state is not None and not run.is_fixed and not is_related(run, given)
    if not is_new or pose is None or not np.isfinite(pose).all():
        return None
    view = jax.tree.map(lambda leaf: leaf[None], as_prediction(given.taken).current)
    alone, config = start(FirstWindow(view, to_se3(run.records[-1].pose[None])), run.camera, run.config)
    if not bool(alone.map.gaussians.valid.any()):
        return None
    time = run.state.time
    map = replace(alone.map, birth=jnp.full_like(alone.map.birth, time))
    return replace(alone, map=map, time=time + 1), config


def enter(run: MappingRun, given: Input, before: SlamState) -> None:
    """Switch to the segment that the last frame has started; the state `before` it is set aside."""
    run.aside = run.aside | {run.back_end.segment: before}
    run.back_end.segment = given.structure
    run.structure, run.prior_motion = placed_by(given, run.records[-1].pose), None


def meeting(run: MappingRun, given: Input, info: StepInfo) -> np.ndarray | None:
    """The similarity (4, 4) from the world of a frame to that of another segment, if it is seen there, else None.

    Its place there must pass what a lost camera's must, the map's word included.

    Args:
        run: before this frame.
        given: this frame.
        info: of its step, in its own segment.
    """
    if not run.aside or not bool(info.localization.is_tracked):
        return None
    place, _ = run.back_end.locate(looks_of(given)[0], elsewhere=True)
    if place is None:
        return None
    other = run.aside[run.back_end.segments[place.by]]
    # The prior's unit in that map is what this frame says.
    belief = replace(other.belief, log_scale=jnp.asarray(place.log_scale, jnp.float32))
    visiting = replace(run, state=replace(other, belief=belief))
    begin, again = found_at(visiting, predicted(run, given), place)
    _, there, _ = advance(begin, again, run.camera, run.config)
    if refusal(there, again, place, run.back_end.config.location) is not None:
        return None
    return similarity_between(info, there)


def similarity_between(here: StepInfo, there: StepInfo) -> np.ndarray:
    """Return the similarity between a frame's two poses, lengths included: (4, 4) with e^σ R in the place of R."""
    before, after = (to_matrix(np.asarray(info.T_world_camera.wxyz_xyz)) for info in (here, there))
    before[:3, :3] *= float(here.localization.scale)
    after[:3, :3] *= float(there.localization.scale)
    return after @ np.linalg.inv(before)


def moved_pose(similarity: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """A pose (4, 4) where a similarity takes it."""
    moved = similarity @ T_world_camera
    moved[:3, :3] /= scale_of(similarity)
    return moved


def scale_of(similarity: np.ndarray) -> float:
    """By which a similarity multiplies lengths."""
    return float(np.cbrt(np.linalg.det(similarity[:3, :3])))


def join(run: MappingRun, given: Input) -> None:
    """Make one segment of that of the last frame, which is a node already, and of the one in which it was found.

    The newer one moves, by the similarity of the record or its inverse.
    """
    end, similarity = run.back_end, run.records[-1].similarity
    place, _ = end.locate(looks_of(given)[-1], elsewhere=True)  # where `meeting` has found it
    here, there = end.segment, end.segments[place.by]
    if here < there:
        similarity = np.linalg.inv(similarity)
    newer, older, before = max(here, there), min(here, there), end.nodes()
    unit = np.exp(end.log_scales[place.by])  # of the place's covariance: its map may be the one that moves
    rows = [row for row, one in enumerate(end.segments) if one == newer]
    for row in rows:
        end.poses[row] = moved_pose(similarity, end.poses[row])
        end.online[row] = moved_pose(similarity, end.online[row])
        end.log_scales[row] += float(np.log(scale_of(similarity)))
    after, first = end.nodes(), row_of_first_node(run) - end.first
    for row in rows:
        run.records[first + row] = _moved_record(similarity, run.records[first + row])
    end.segments = [older if one == newer else one for one in end.segments]
    end.segment, end.has_one_unit = older, False
    end.edges.append(edge_to_place(end, place, unit))
    other = run.aside[there]
    run.aside = {one: state for one, state in run.aside.items() if one != there}
    state = follow(run.state, before, after, end.min_std, end.config.deform)
    moved = move_map(other.map, before, after, jnp.asarray(end.min_std, jnp.float32), end.config.deform)
    map, run.config = with_part(state.map, moved, run.config)
    run.state = replace(state, map=map)
    if here == newer:
        factor = jnp.asarray(scale_of(similarity), jnp.float32)
        run.state = replace(run.state, belief=rescaled_belief(state.belief, factor))
        run.prior_motion = anchored_by(run.records[-1], predicted(run, given))


def edge_to_place(end: BackEnd, place: Location, unit: float) -> Edge:
    """Build the join factor of two segments: the last node relative to the keyframe that relocalized it, as now.

    `unit` is a length of that keyframe's inference in the map in which the pose was found.
    """
    a, b = place.by, len(end.poses) - 1
    scale = np.exp(end.log_scales[a])
    units = np.array([unit] * 3 + [1.0] * 4)
    information = np.linalg.inv(place.covariance / units[:, None] / units)
    measured = rescaled(np.linalg.inv(end.poses[a]) @ end.poses[b], 1.0 / scale)
    ratio = end.log_scales[b] - end.log_scales[a]
    return Edge(a, b, measured, ratio, np.linalg.cholesky(information).T, ODOMETRY)


def _moved_record(similarity: np.ndarray, record: FrameRecord) -> FrameRecord:
    scale = scale_of(similarity)
    units = np.array([scale] * 3 + [1.0] * 3)
    poses = {name: getattr(record, name) for name in ("pose", "newest_pose")}
    return replace(
        record,
        **{name: None if pose is None else moved_pose(similarity, pose) for name, pose in poses.items()},
        covariance=None if record.covariance is None else units[:, None] * record.covariance * units,
        scale=None if record.scale is None else scale * record.scale,
    )


def leave_out(run: MappingRun) -> None:
    """Keep the segment of most placed frames, or the saved map's; nothing fuses what was never joined with it.

    The other frames are lost: their poses are relative to where each segment stood in.
    """
    if not run.aside:
        return
    end = run.back_end
    counts = Counter(one for one, is_placed in zip(end.segments, end.is_placed, strict=True) if is_placed)
    kept = 0 if run.saved is not None else max(sorted(counts), key=lambda one: counts[one])
    run.state, run.aside = ({end.segment: run.state} | run.aside)[kept], {}
    is_kept = [one == kept for one in end.segments]
    end.is_placed = [placed and here for placed, here in zip(end.is_placed, is_kept, strict=True)]
    end.segment = kept
    for name in ("edges", "verified", "contradicted", "accepted"):
        setattr(end, name, [one for one in getattr(end, name) if is_kept[one.a] and is_kept[one.b]])
    known = end.database
    rows = [row for row, one in enumerate(known.keyframes) if is_kept[one.frame]]
    end.database = replace(known, keyframes=tuple(known.keyframes[row] for row in rows), vectors=known.vectors[rows])
    first = row_of_first_node(run) - end.first
    for row in range(end.first, len(is_kept)):
        if not is_kept[row]:
            lost = {"status": "lost", "reason": UNJOINED, "covariance": None}
            run.records[first + row] = replace(run.records[first + row], **lost)
