"""Do loops fit each other, and what the graph knows already?

By appearance two rooms that are furnished alike are one place, and all loops between them agree on one correction. If
there are keyframes that it brings together and that see through each other's surfaces, as at the end of the hall before
the rooms, it is wrong as a whole, also between keyframes that see nothing of that. Without such a view only the path is
left: that the camera cannot have come back, as far as that is known.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from emgs_jax.loops.two_views import gap_between, rescaled
from emgs_jax.loops.verification import LoopMeasurement
from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class AgreementConfig:
    """When two loops say the same; gaps count frames, lengths are the map's.

    Args:
        max_query_gap, max_candidate_gap: between the queries and between the candidates of two loops.
        max_distance: between where they put one query.
        max_turn_deg: likewise.
        min_others: loops, each of another query, that a loop needs.
        max_contradicted: queries of contradicted loops, among all that agree one after the other.
    """

    max_query_gap: int = number(low=0)
    max_candidate_gap: int = number(low=0)
    max_distance: float = number(low=0, high=math.inf)
    max_turn_deg: float = number(low=0, high=math.inf)
    min_others: int = number(low=0)
    max_contradicted: int = number(low=0)


def agreeing(
    loops: Sequence[LoopMeasurement],
    contradicted: Sequence[LoopMeasurement],
    poses: Mapping[int, Float[np.ndarray, "4 4"]],
    log_scales: Mapping[int, float],
    config: AgreementConfig,
) -> Bool[np.ndarray, " n"]:
    """Which loops have enough others, of nearby queries to nearby candidates, that imply the same correction.

    The correction of one, T_implied T_now⁻¹, must fit the query of the other.

    A false match of repeating texture is alone, or one of many that all say something else. Loops that agree one after
    the other are one statement, however far the path drifts in the meantime, and fall together if it is contradicted:
    see the top of this file.

    Args:
        contradicted: `VerifyInfo.contradicted` of those that were refused.
        poses: T_world_camera of every frame of a loop, as they are now.
        log_scales: σ of these: a length of the inference times e^σ is one of the map.
    """
    every = [*loops, *contradicted]
    if not every:
        return np.zeros(0, bool)
    implied = np.stack([poses[loop.a] @ rescaled(loop.Z_a_b, np.exp(log_scales[loop.a])) for loop in every])
    now = np.stack([poses[loop.b] for loop in every])
    corrections = implied @ np.linalg.inv(now)
    queries, candidates = (np.array([getattr(loop, name) for loop in every]) for name in ("b", "a"))
    one, other = pairs_within(queries, config.max_query_gap)
    is_near = np.abs(candidates[one] - candidates[other]) <= config.max_candidate_gap
    one, other = one[is_near], other[is_near]
    distance, turn = gap_between(corrections[other] @ now[one], implied[one])
    fits = (distance <= config.max_distance) & (turn <= config.max_turn_deg)
    agree = coo_array((fits, (one, other)), shape=(len(every), len(every))).tocsr()
    agree = agree * agree.T
    one, other = agree.nonzero()
    _, group = connected_components(agree, directed=False)
    is_evidence = np.arange(len(every)) < len(loops)
    backs = is_evidence[other] & (queries[one] != queries[other])
    num_others = _num_different(one[backs], queries[other[backs]], len(every))
    num_against = _num_different(group[~is_evidence], queries[~is_evidence], len(every))[group]
    is_accepted = (num_others >= config.min_others) & (num_against <= config.max_contradicted)
    return is_accepted[: len(loops)]


def pairs_within(frames: Int[np.ndarray, " n"], max_gap: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Positions in `frames` of all pairs that lie within a gap of each other, in both orders, each with itself, too."""
    order = np.argsort(frames, kind="stable")
    ordered = frames[order]
    begin, end = (
        np.searchsorted(ordered, ordered + gap, side) for gap, side in ((-max_gap, "left"), (max_gap, "right"))
    )
    count = end - begin
    one = np.repeat(np.arange(len(frames)), count)
    other = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
    return order[one], order[other]


def _num_different(rows: Int[np.ndarray, " n"], values: Int[np.ndarray, " n"], num_rows: int) -> Int[np.ndarray, " r"]:
    """How many different values stand in each row."""
    return np.bincount(np.unique(np.stack([rows, values]), axis=1)[0], minlength=num_rows)
