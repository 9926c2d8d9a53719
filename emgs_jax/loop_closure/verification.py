"""Verification of loop candidates: both keyframes show one place, neighbours confirm it, no free space is violated.

A loop that passes all gates may still be wrong: two rooms with the same furniture look like one place. Spatial
consistency tells them apart, see `consistency`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from emgs_jax.geometry import pose_difference, scale_pose, transform_points
from emgs_jax.loop_closure.place_recognition import Keyframe, grid_pixels
from emgs_jax.loop_closure.two_view_alignment import Aligned, AlignmentConfig, Gate, RefusedError, align, require
from emgs_jax.loop_closure.two_view_refinement import Similarity
from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class VerificationConfig:
    """Thresholds beyond those of two keyframes; lengths in units of the candidate's inference.

    Args:
        alignment: of query and candidate, and of query and each neighbour.
        min_neighbours: neighbours of the candidate that must be verified, too.
        max_neighbour_gap, max_neighbour_distance: candidate and neighbour may place the camera apart by the first times
            the median depth, plus the second.
        max_neighbour_turn_deg: angle between these two poses.
        max_free_space_violation: share of the commonly visible surface that lies in free space of the other camera.
        free_space_margin: fraction of the depth by which it must be in front.
    """

    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    min_neighbours: int = number(2, low=0, high=1000)
    max_neighbour_gap: float = number(0.02, low=0, high=math.inf)
    max_neighbour_distance: float = number(0.015, low=0, high=math.inf)
    max_neighbour_turn_deg: float = number(3.0, low=0, high=math.inf)
    max_free_space_violation: float = number(0.02, low=0, high=1)
    free_space_margin: float = number(0.15, low=0)


@dataclass(frozen=True)
class Neighbour:
    """A keyframe near a candidate, with its known relative pose.

    Args:
        T_candidate_neighbour: camera neighbour -> camera candidate, in units of the candidate's inference.
        log_ratio: σ_neighbour - σ_candidate, where a length of an inference times e^σ is one of the map; 0 if both are
            metric.
    """

    keyframe: Keyframe
    T_candidate_neighbour: Float[np.ndarray, "4 4"]
    log_ratio: float = 0.0


@dataclass(frozen=True)
class LoopMeasurement:
    """A verified loop: the relative pose of a, the candidate, and b, the query.

    Args:
        a, b: their frames.
        Z_a_b: camera b -> camera a, in units of a's inference.
        log_ratio: σ_b - σ_a: log of the median ratio of a point's depth in a's inference to that in b's.
        sqrt_info: W, upper triangular, with WᵀW the information on (translation, rotation, log-ratio), if the truth is
            Z Exp(·).
        num_inliers: points that fit in every direction for which they have a depth.
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
        refused_by: the first gate that failed; None if accepted.
        measured: the value that this gate compares with its threshold; NaN if accepted.
        violation: the measurement of a loop whose matches fit but which violates free space: evidence against all
            loops that imply the same correction.
    """

    refused_by: Gate | None = None
    measured: float = float("nan")
    violation: LoopMeasurement | None = None


def verify(
    query: Keyframe, candidate: Keyframe, neighbours: Sequence[Neighbour], config: VerificationConfig
) -> tuple[LoopMeasurement | None, VerifyInfo]:
    """Measure the query's camera relative to the candidate's; None, with the reason, if this is not certain.

    Args:
        neighbours: keyframes just before and after the candidate, with known poses relative to it.
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
    poses: Sequence[Float[np.ndarray, "4 4"]] | Mapping[int, Float[np.ndarray, "4 4"]],
    log_scales: Sequence[float] | Mapping[int, float],
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
    """Check that enough neighbours are verified, and that each of these places the query where the candidate does."""
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


def free_space_violation(a: Keyframe, b: Keyframe, similarity: Similarity, margin: float) -> float:
    """Return the share of commonly visible surface that lies in free space of the other camera; the larger of both.

    Args:
        similarity: of camera b in the frame of a.
        margin: fraction of the depth by which it must be nearer than everything that the other sees around it.
    """
    points_b = np.exp(similarity.log_ratio) * _points(b)
    T_b_a = np.linalg.inv(similarity.T_a_b)
    in_units_of_b = np.exp(-similarity.log_ratio)
    return max(
        _share(transform_points(similarity.T_a_b, points_b), a, margin),
        _share(in_units_of_b * transform_points(T_b_a, _points(a)), b, margin),
    )


def _points(keyframe: Keyframe) -> Float[np.ndarray, "n 3"]:
    """Back-project the keyframe's depth grid to camera-frame points, where it has a depth."""
    fx, fy, cx, cy = keyframe.intrinsics
    x, y = np.meshgrid(*grid_pixels(keyframe.size, keyframe.depths.shape[::-1]))
    z = np.float64(keyframe.depths)
    return np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], axis=-1)[z > 0]


def _share(points: Float[np.ndarray, "n 3"], keyframe: Keyframe, margin: float) -> float:
    """Return the share of points in a keyframe's image that lie in front of its surface; 0 if it sees none."""
    fx, fy, cx, cy = keyframe.intrinsics
    (w, h), (rows, columns) = keyframe.size, keyframe.depths.shape
    points = points[points[:, 2] > 0]
    column = np.floor((points[:, 0] / points[:, 2] * fx + cx + 0.5) * columns / w)
    row = np.floor((points[:, 1] / points[:, 2] * fy + cy + 0.5) * rows / h)
    is_inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    # The nearest depth around: beside an edge, image and point may show different surfaces. 0 = unknown.
    nearest = minimum_filter(np.float64(keyframe.depths), 3, mode="nearest")
    shown = nearest[row[is_inside].astype(int), column[is_inside].astype(int)]
    is_through = points[is_inside, 2] < (1 - margin) * shown
    return float(is_through.sum() / max((shown > 0).sum(), 1))
