"""Verification of loop candidates: the two keyframes show the same, neighbours confirm it, no free space is violated.

A loop that passes all gates may still be wrong: two rooms that are furnished alike look like one place. Spatial
consistency tells them apart, see `consistency`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.geometry import pose_difference, scale_pose
from emgs_jax.loop_closure.free_space import free_space_violation
from emgs_jax.loop_closure.place_recognition import Keyframe
from emgs_jax.loop_closure.two_view_alignment import Aligned, AlignmentConfig, Gate, RefusedError, align, require
from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class VerificationConfig:
    """Thresholds beyond those of two keyframes; lengths in units of the candidate's inference.

    Args:
        alignment: of query and candidate, and of query and each neighbour.
        min_neighbours: of the candidate that must be verified too.
        max_neighbour_gap, max_neighbour_distance: the camera may be elsewhere by this times the median depth plus this.
        max_neighbour_turn_deg: between the poses by way of candidate and neighbour.
        max_free_space_violation: share of the surface that both show that is in free space of the other.
        free_space_margin: share of the depth by which it must be in the way.
    """

    alignment: AlignmentConfig
    min_neighbours: int = number(low=0, high=1000)
    max_neighbour_gap: float = number(low=0, high=math.inf)
    max_neighbour_distance: float = number(low=0, high=math.inf)
    max_neighbour_turn_deg: float = number(low=0, high=math.inf)
    max_free_space_violation: float = number(low=0, high=1)
    free_space_margin: float = number(low=0)


@dataclass(frozen=True)
class Neighbour:
    """A keyframe near a candidate, and where it is known to be.

    Args:
        T_candidate_neighbour: camera neighbour -> camera candidate, in units of the candidate's inference.
        log_ratio: σ_neighbour - σ_candidate, where a length of an inference times e^σ is metric; 0 where both are.
    """

    keyframe: Keyframe
    T_candidate_neighbour: Float[np.ndarray, "4 4"]
    log_ratio: float = 0.0


@dataclass(frozen=True)
class LoopMeasurement:
    """An edge of the graph between a, the candidate, and b, the query.

    Args:
        a, b: their frames.
        Z_a_b: camera b -> camera a, in units of a's inference.
        log_ratio: σ_b - σ_a: log of the median ratio of a point's depth in a's inference over that in b's.
        sqrt_info: W, upper triangular, with WᵀW the information of (translation, rotation, log-ratio) where the truth
            is Z Exp(·).
        num_inliers: points that fit in every direction in which they have a depth.
    """

    a: int
    b: int
    Z_a_b: Float[np.ndarray, "4 4"]
    log_ratio: float
    sqrt_info: Float[np.ndarray, "7 7"]
    num_inliers: int


@dataclass(frozen=True)
class VerifyInfo:
    """Why a candidate was refused.

    Args:
        refused_by: the first gate that it did not pass; None if accepted.
        measured: what that gate compares with its threshold; NaN if accepted.
        violation: the measurement of a loop whose matches fit but which violates free space: evidence against all
            loops that imply the same correction.
    """

    refused_by: Gate | None = None
    measured: float = float("nan")
    violation: LoopMeasurement | None = None


def verify(
    query: Keyframe, candidate: Keyframe, neighbours: Sequence[Neighbour], config: VerificationConfig
) -> tuple[LoopMeasurement | None, VerifyInfo]:
    """Measure where the query's camera is from the candidate's; None with the reason where it is not sure to be there.

    Args:
        neighbours: keyframes just before and after the candidate, which know their place from it without the query.
    """
    try:
        found = align(candidate, query, config.alignment)
        _check_neighbours(found, query, neighbours, config)
    except RefusedError as refused:
        return None, VerifyInfo(refused.gate, refused.measured)
    similarity = found.similarity
    sqrt_info = np.linalg.cholesky(np.linalg.inv(similarity.covariance)).T
    pose, log_ratio = similarity.T_a_b, similarity.log_ratio
    loop = LoopMeasurement(candidate.frame, query.frame, pose, log_ratio, sqrt_info, found.num_inliers)
    share = free_space_violation(candidate, query, similarity, config.free_space_margin)
    if share > config.max_free_space_violation:
        return None, VerifyInfo(Gate.FREE_SPACE, share, loop)
    return loop, VerifyInfo()


def neighbours_of(
    candidate: Keyframe,
    others: Sequence[Keyframe],
    poses: Sequence[Float[np.ndarray, "4 4"]],
    log_scales: Sequence[float],
) -> list[Neighbour]:
    """Return other keyframes with their poses and log-scales relative to a candidate; inputs are indexed by frame."""
    inverse, scale = np.linalg.inv(poses[candidate.frame]), log_scales[candidate.frame]
    return [
        Neighbour(one, scale_pose(inverse @ poses[one.frame], np.exp(-scale)), log_scales[one.frame] - scale)
        for one in others
    ]


def _check_neighbours(
    found: Aligned, query: Keyframe, neighbours: Sequence[Neighbour], config: VerificationConfig
) -> None:
    """Every neighbour that is verified alone must put the query where the candidate does; enough of them must be."""
    verified = 0
    for neighbour in neighbours:
        try:
            similarity = align(neighbour.keyframe, query, config.alignment).similarity
        except RefusedError:
            continue
        T_neighbour_query = scale_pose(similarity.T_a_b, np.exp(neighbour.log_ratio))
        distance, turn = pose_difference(neighbour.T_candidate_neighbour @ T_neighbour_query, found.similarity.T_a_b)
        allowed = config.max_neighbour_gap * found.median_depth + config.max_neighbour_distance
        require(Gate.NEIGHBOURS_DISAGREE, distance <= allowed, distance)
        require(Gate.NEIGHBOURS_DISAGREE, turn <= config.max_neighbour_turn_deg, turn)
        verified += 1
    require(Gate.NEIGHBOURS, verified >= config.min_neighbours, verified)
