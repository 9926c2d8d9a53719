"""Spatial consistency of loops: which of them imply the same correction of the poses.

Two rooms with the same furniture look like one place, and all loops between them imply the same correction. The whole
correction is wrong, also between keyframes without a free-space violation, if it brings together any keyframes that see
through each other's surfaces, as at the end of the hall outside the rooms. Without such a view, only the path can show
that the camera cannot have returned.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from emgs_jax.geometry import pose_difference, scale_pose
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.ops.ranges import number

QUERIES = 50  # of a chain, for which the allowed violations are counted


@dataclass(frozen=True)
class ConsistencyConfig:
    """Thresholds by which loops are spatially consistent; gaps count frames, lengths are the map's.

    Args:
        max_query_gap, max_candidate_gap: between the queries and between the candidates of two loops.
        max_distance: between the positions that two loops imply for one query.
        min_others: consistent loops of other queries that a loop needs.
        max_violating_queries: allowed queries with a free-space violation in a chain of consistent loops, for each
            `QUERIES` queries of the chain, rounded up: what was moved, or a wrong depth, violates a long chain more
            often than a short one.
    """

    max_query_gap: int = number(30, low=0)
    max_candidate_gap: int = number(30, low=0)
    max_distance: float = number(0.15, low=0, high=math.inf)
    max_turn_deg: float = number(4.0, low=0, high=math.inf)
    min_others: int = number(2, low=0)
    max_violating_queries: int = number(1, low=0)


def spatially_consistent(
    loops: Sequence[LoopMeasurement],
    violating: Sequence[LoopMeasurement],
    poses: Mapping[int, Float[np.ndarray, "4 4"]],
    log_scales: Mapping[int, float],
    config: ConsistencyConfig,
) -> Bool[np.ndarray, " n"]:
    """Test which loops (n,) are spatially consistent: enough others imply the same correction.

    Only loops of nearby queries to nearby candidates are compared: the correction of one, T_implied T_now⁻¹, must fit
    the query of the other.

    A false match of repeating texture is alone, or one of many that all imply different corrections. Consistent loops
    form chains, however far the path drifts meanwhile. A chain with too many free-space violations is rejected, see the
    top of this file.

    Args:
        loops: verified ones.
        violating: `VerifyInfo.violation` of loops that were rejected for a free-space violation.
        poses: current T_world_camera of every frame of a loop.
        log_scales: σ of these frames: a length of the inference times e^σ is one of the map.
    """
    every = [*loops, *violating]
    if not every:
        return np.zeros(0, bool)
    implied = np.stack([poses[loop.a] @ scale_pose(loop.Z_a_b, np.exp(log_scales[loop.a])) for loop in every])
    now = np.stack([poses[loop.b] for loop in every])
    corrections = implied @ np.linalg.inv(now)
    queries, candidates = (np.array([getattr(loop, name) for loop in every]) for name in ("b", "a"))
    one, other = pairs_within(queries, config.max_query_gap)
    is_near = np.abs(candidates[one] - candidates[other]) <= config.max_candidate_gap
    one, other = one[is_near], other[is_near]
    distance, turn = pose_difference(corrections[other] @ now[one], implied[one])
    fits = (distance <= config.max_distance) & (turn <= config.max_turn_deg)
    agree = coo_array((fits, (one, other)), shape=(len(every), len(every))).tocsr()
    agree = agree * agree.T
    one, other = agree.nonzero()
    _, group = connected_components(agree, directed=False)
    is_evidence = np.arange(len(every)) < len(loops)
    backs = is_evidence[other] & (queries[one] != queries[other])
    num_others = _num_different(one[backs], queries[other[backs]], len(every))
    num_for, num_against = (
        _num_different(group[of], queries[of], len(every))[group] for of in (is_evidence, ~is_evidence)
    )
    is_allowed = num_against <= config.max_violating_queries * np.ceil(num_for / QUERIES)
    is_accepted = (num_others >= config.min_others) & is_allowed
    return is_accepted[: len(loops)]


def pairs_within(frames: Int[np.ndarray, " n"], max_gap: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Find all pairs of positions in `frames` within a gap of each other, in both orders, also each with itself."""
    order = np.argsort(frames)
    ordered = frames[order]
    begin, end = (
        np.searchsorted(ordered, ordered + gap, side) for gap, side in ((-max_gap, "left"), (max_gap, "right"))
    )
    count = end - begin
    one = np.repeat(np.arange(len(frames)), count)
    other = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
    return order[one], order[other]


def _num_different(rows: Int[np.ndarray, " n"], values: Int[np.ndarray, " n"], num_rows: int) -> Int[np.ndarray, " r"]:
    """Count the different values in each row 0..num_rows-1."""
    return np.bincount(np.unique(np.stack([rows, values]), axis=1)[0], minlength=num_rows)
