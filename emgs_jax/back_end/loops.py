"""Loops: detect them by keyframes, verify them, query the prior, and check spatial consistency."""

import math
from collections.abc import Sequence
from dataclasses import replace

from emgs_jax.back_end.factors import FrameData, chi2
from emgs_jax.back_end.state import BackEnd, Refusal
from emgs_jax.loop_closure.consistency import spatially_consistent
from emgs_jax.loop_closure.place_recognition import (
    Keyframe,
    add_keyframe,
    make_keyframe,
    most_similar,
    propose_candidates,
    propose_for_all,
)
from emgs_jax.loop_closure.prior_query import PriorQuery, fuse_measurements, measure_by_prior
from emgs_jax.loop_closure.relocalization import NO_CANDIDATE, PosedKeyframes, RelocalizedPose, relocalize
from emgs_jax.loop_closure.two_view_alignment import Gate
from emgs_jax.loop_closure.verification import LoopMeasurement, VerificationConfig, neighbours_of, verify

# Outcomes of a query: a second measurement, no answer, or an answer without a pose or enough depths.
MEASURED, SILENT, UNUSABLE = "measured", "silent", "unusable"


def detect_loops(end: BackEnd, frame: FrameData) -> BackEnd:
    """Add the last node as a keyframe, unless it opens its map, and verify its loop candidates.

    The frame that opens a map was registered to nothing, so where it is beside the next ones is known least of all.
    """
    time, config = len(end.nodes) - 1, end.config.place_recognition
    if time % end.config.every or all(node.submap != end.active for node in end.nodes[:-1]):
        return end
    end = replace(end, database=add_keyframe(end.database, _keyframe(end, time, frame), config))
    row = len(end.database.keyframes) - 1
    for candidate in propose_candidates(end.database, row, config):
        if _submap_id_of(end, candidate) == end.active:
            end = _verify_candidate(end, row, candidate)
    return end


def detect_loops_between(end: BackEnd, submap_id: int, is_one_walk: bool = False) -> BackEnd:
    """Verify loops between the keyframes of a submap, whose unit may differ, and those of the active one.

    The submap's nodes come after those of the active one. If both are of one walk, these keyframes have the candidates
    that they would have in one run.
    """
    config, is_placed = end.config.place_recognition, [end.nodes[one.frame].is_placed for one in end.database.keyframes]
    known, queries = (
        [row for row, ok in enumerate(is_placed) if ok and _submap_id_of(end, row) == number]
        for number in (end.active, submap_id)
    )
    if is_one_walk:
        there = {*known}
        proposed = ([one for one in each if one in there] for each in propose_for_all(end.database, queries, config))
    else:
        asked = (end.database.keyframes[row] for row in queries)
        proposed = (most_similar(end.database, one, known, config.num_candidates, config) for one in asked)
    for row, candidates in zip(queries, proposed, strict=True):
        for candidate in candidates:
            end = _verify_candidate(end, row, candidate, is_free=True)
    return end


def recent_loops(end: BackEnd) -> list[LoopMeasurement]:
    """Select spatially consistent loops of the latest queries that are not in the pose graph yet, after a keyframe."""
    time = len(end.nodes) - 1
    if time % end.config.every:
        return []
    return not_in_graph(end, consistent_loops(end, since=time - end.config.consistency.max_query_gap))


def _keyframe(end: BackEnd, time: int, frame: FrameData) -> Keyframe:
    return make_keyframe(time, frame.image, frame.points, frame.mask, end.intrinsics, end.config.place_recognition)


def relocalize_frame(
    end: BackEnd, frame: FrameData, in_other_submap: bool = False
) -> tuple[RelocalizedPose | None, str | None]:
    """Relocalize a frame by keyframes of its submap that are in the map; return its pose, or why that fails.

    Args:
        frame: a frame that is not a node yet, or not a keyframe.
        in_other_submap: search the other submap that has the most similar keyframe, with a free ratio of units.
    """
    query = _keyframe(end, len(end.nodes), frame)
    submap_id = _most_similar_submap(end, query) if in_other_submap else end.active or 0
    if submap_id is None:
        return None, NO_CANDIDATE
    is_there = [node.is_placed and node.submap == submap_id for node in end.nodes]
    known = PosedKeyframes(end.database, end.poses, end.log_scales, is_there)
    verification = _verification_config(end, in_other_submap)
    return relocalize(query, known, end.config.place_recognition, verification, end.config.relocalization)


def _most_similar_submap(end: BackEnd, query: Keyframe) -> int | None:
    """Find the other submap with the most similar keyframe that is in its map; None without one."""
    keyframes = end.database.keyframes
    others = [row for row in range(len(keyframes)) if _submap_id_of(end, row) != end.active]
    others = [row for row in others if end.nodes[keyframes[row].frame].is_placed]
    found = most_similar(end.database, query, others, 1, end.config.place_recognition)
    return _submap_id_of(end, found[0]) if found else None


def _submap_id_of(end: BackEnd, row: int) -> int:
    """Look up the submap of a keyframe, a row of the database."""
    return end.nodes[end.database.keyframes[row].frame].submap


def _verification_config(end: BackEnd, is_free: bool) -> VerificationConfig:
    """Return the settings of verification; the ratio of the two units is free if they may differ."""
    config = end.config.verification
    if end.has_one_unit and not is_free:
        return config
    return replace(config, alignment=replace(config.alignment, scale_std=math.inf))


def consistent_loops(end: BackEnd, since: int = 0) -> list[LoopMeasurement]:
    """Select the verified loops of queries from `since` on that are spatially consistent with others."""
    recent = [loop for loop in end.verified if loop.b >= since]
    poses, log_scales = (dict(enumerate(values)) for values in (end.poses, end.log_scales))
    yes = spatially_consistent(recent, end.violating, poses, log_scales, end.config.consistency)
    return [loop for loop, ok in zip(recent, yes, strict=True) if ok]


def not_in_graph(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select the loops that are not in the pose graph yet."""
    known = {(loop.a, loop.b) for loop in end.accepted}
    return [loop for loop in loops if (loop.a, loop.b) not in known]


def remove_inconsistent(end: BackEnd) -> BackEnd:
    """Remove the factors of accepted loops that are no longer spatially consistent."""
    good = {(loop.a, loop.b) for loop in consistent_loops(end)}
    accepted = [loop for loop in end.accepted if (loop.a, loop.b) in good]
    factors = [one for one in end.factors if not one.is_loop or (one.a, one.b) in good]
    return replace(end, accepted=accepted, factors=factors)


def _verify_candidate(end: BackEnd, row: int, other: int, is_free: bool = False) -> BackEnd:
    """Verify a loop between two keyframes, rows of the database, the later first, and record the outcome."""
    keyframes = end.database.keyframes
    candidate, rows = keyframes[other], (k for k in range(other - 2, other + 3) if 0 <= k < row and k != other)
    beside = [keyframes[k] for k in rows if _submap_id_of(end, k) == end.active]
    beside = sorted(beside, key=lambda one: abs(one.frame - candidate.frame))[:2]  # at an end both of one side
    near = {one.frame: end.nodes[one.frame] for one in (candidate, *beside)}
    poses, log_scales = ({row: getattr(node, name) for row, node in near.items()} for name in ("pose", "log_scale"))
    neighbours = neighbours_of(candidate, beside, poses, log_scales)
    loop, info = verify(keyframes[row], candidate, neighbours, _verification_config(end, is_free))
    if info.violation is not None:
        end = replace(end, violating=[*end.violating, info.violation])
    if loop is not None:
        return replace(end, verified=[*end.verified, loop])
    refusal = Refusal(candidate.frame, keyframes[row].frame, info.refused_by.value, info.measured)
    return replace(end, refusals=[*end.refusals, refusal])


def is_closure_due(end: BackEnd, loops: Sequence[LoopMeasurement]) -> bool:
    """Test whether a closure is due: a loop violates the current poses, and the last closure is long enough ago."""
    last = end.closures[-1].time if end.closures else -end.config.min_frames
    return len(end.nodes) - 1 - last >= end.config.min_frames and bool(violated(end, loops))


def violated(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select the loops that the current poses violate: χ² above `min_violation`."""
    poses, log_scales = end.poses, end.log_scales
    return [loop for loop in loops if chi2(loop, poses, log_scales) > end.config.min_violation]


def query_prior(end: BackEnd, loops: Sequence[LoopMeasurement], query: PriorQuery) -> BackEnd:
    """Query the prior for loops, each once: a measurement that fits is fused, any other rejects the loop.

    A rejected loop is evidence against all loops that imply the same correction, like a free-space violation. A loop
    without an answer stays as it is, and so does one with a frame of another run.
    """
    keyframes = {keyframe.frame: keyframe for keyframe in end.database.keyframes}
    for loop in _loops_to_query(end, loops):
        pair = loop.a, loop.b
        answer = query(*(end.nodes[row].frame for row in pair))
        other = (
            None
            if answer is None
            else measure_by_prior(answer, *(keyframes[node] for node in pair), end.config.prior_query)
        )
        outcome = MEASURED if other is not None else SILENT if answer is None else UNUSABLE
        end = replace(end, queries=end.queries | {pair: outcome})
        if other is None:
            continue
        both, misfit = fuse_measurements(loop, other)
        known = end.verified
        row = [(one.a, one.b) for one in known].index(pair)
        before, after = end.verified[:row], end.verified[row + 1 :]
        if misfit <= end.config.prior_query.max_misfit:
            end = replace(end, verified=[*before, both, *after])
        else:
            refusal = Refusal(*pair, Gate.PRIOR_QUERY.value, misfit)
            end = replace(end, verified=[*before, *after], refusals=[*end.refusals, refusal])
            end = replace(end, violating=[*end.violating, known[row]])
    return end


def _loops_to_query(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select new loops with most inliers: the best of each query frame, at most `max_queries`."""
    new = [loop for loop in loops if (loop.a, loop.b) not in end.queries and loop.a >= end.first_node]
    best = {loop.b: loop for loop in sorted(new, key=lambda loop: loop.num_inliers)}
    return sorted(best.values(), key=lambda loop: -loop.num_inliers)[: end.config.prior_query.max_queries]
