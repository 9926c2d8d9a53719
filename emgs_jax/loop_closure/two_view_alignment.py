"""Relative pose of two keyframes of one place, with gates on the pair, cheap ones first."""

import math
from dataclasses import dataclass, field
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.geometry import pose_difference, scale_pose
from emgs_jax.keypoints.poses import calibration, essential, pose_of
from emgs_jax.keypoints.sift import mutual
from emgs_jax.loop_closure.place_recognition import Keyframe, unit_descriptors
from emgs_jax.loop_closure.two_view_refinement import Pairs, RefineConfig, Similarity, log_ratios, refine
from emgs_jax.ops.constants import MAD_TO_STD
from emgs_jax.ops.ranges import number

MIN_POSE = 6  # points that a pose needs


class Gate(StrEnum):
    """Reasons to reject a loop candidate, in the order in which the gates are tested, each with words for people."""

    words: str

    def __new__(cls, name: str, words: str) -> "Gate":
        """Make the gate that files call by a name."""
        gate = str.__new__(cls, name)
        gate._value_, gate.words = name, words
        return gate

    MATCHES = "matches", "too few matches fit one motion of the camera"
    MATCH_SHARE = "match_share", "too many matches do not fit one motion of the camera"
    POSE = "pose", "too few points of the one fit the image of the other"
    POSES_DISAGREE = "poses_disagree", "the pose from the points of the one is not that from those of the other"
    HULL = "hull", "what both show is in a small part of an image"
    COLLINEAR = "collinear", "what both show lies on a line"
    SMALL = "small", "what both show is one small object"
    DEPTHS = "depths", "the ratios of the depths scatter"
    SCALE = "scale", "the scale is not that of a metric prior"
    NEIGHBOURS = "neighbours", "too few of the neighbouring frames are verified as well"
    NEIGHBOURS_DISAGREE = "neighbours_disagree", "the neighbouring frames say otherwise"
    FREE_SPACE = "contradicted", "the one looks through what the other sees"
    PRIOR_QUERY = "revisit", "the prior, asked for both together, says otherwise"


@dataclass(frozen=True)
class AlignmentConfig:
    """Thresholds; lengths in units of the first keyframe's inference, errors in pixels.

    Args:
        max_ratio: distance to the best descriptor over that to the second.
        max_epipolar_error: of a match that fits the essential matrix.
        min_matches: number of matches that fit it.
        max_reprojection_error: of a point that fits a pose.
        min_pose_points: number of points that fit, in either direction.
        max_pose_gap: distance between the poses of the two directions, as a fraction of the median depth.
        max_pose_turn_deg: angle between them.
        min_hull: area of the points' convex hull in either image, as a share of the image.
        min_flatness: ratio of the second to the first standard deviation of the points; 0 on a line.
        min_extent: between the 5 % and the 95 % quantile along one of the axes.
        max_depth_scatter: standard deviation of the points' log depth ratio (from the MAD).
        scale_std: of the prior's log-scale; the log-ratio of two may be 3 √2 times that. Infinite unless the prior is
            metric.
    """

    max_ratio: float = number(0.85, low=0, high=1)
    max_epipolar_error: float = number(1.5, low=0, high=1000)
    min_matches: int = number(30, low=MIN_POSE)
    min_match_share: float = number(0.3, low=0, high=1)
    max_reprojection_error: float = number(2.0, low=0, high=1000)
    min_pose_points: int = number(20, low=MIN_POSE)
    max_pose_gap: float = number(0.1, low=0, high=math.inf)
    max_pose_turn_deg: float = number(5.0, low=0, high=math.inf)
    min_hull: float = number(0.1, low=0, high=1)
    min_flatness: float = number(0.05, low=0, high=1)
    min_extent: float = number(0.2, low=0)
    max_depth_scatter: float = number(0.1, low=0, high=math.inf)
    scale_std: float = number(0.03, low=0, high=math.inf)
    refine: RefineConfig = field(default_factory=RefineConfig)


class RefusedError(Exception):
    """A keyframe pair fails a gate.

    Args:
        measured: what the gate compares with its threshold.
    """

    def __init__(self, gate: Gate, measured: float) -> None:
        super().__init__(f"{gate}: {measured:.3g}")
        self.gate, self.measured = gate, float(measured)


@dataclass(frozen=True)
class Aligned:
    """Two keyframes of the same place.

    Args:
        similarity: of camera b in the frame of a.
        num_inliers: points that fit in every direction for which they have a depth.
        median_depth: of these points, in a's units.
    """

    similarity: Similarity
    num_inliers: int
    median_depth: float


def require(gate: Gate, passes: bool, measured: float) -> None:
    """Raise RefusedError if a gate is not passed."""
    if not passes:
        raise RefusedError(gate, measured)


def align(a: Keyframe, b: Keyframe, config: AlignmentConfig) -> Aligned:
    """Compute the similarity between two keyframes; raise RefusedError if they may not show the same place."""
    pairs = _matched(a, b, config)
    T_a_b, by_points_of_a = _posed(pairs.points_a, pairs.pixels_b, pairs.K_b, config)
    T_b_a, by_points_of_b = _posed(pairs.points_b, pairs.pixels_a, pairs.K_a, config)
    in_a, in_b = np.isfinite(pairs.points_a[:, 2]), np.isfinite(pairs.points_b[:, 2])
    # A point that fits in only one direction has a wrong depth in the other.
    fits = (by_points_of_a | ~in_a) & (by_points_of_b | ~in_b) & (in_a | in_b)
    both = pairs.rows(fits & in_a & in_b)
    require(Gate.POSE, len(both.pixels_a) >= MIN_POSE, len(both.pixels_a))
    log_ratio = float(np.median(np.log(_depths(T_a_b, both.points_a) / both.points_b[:, 2])))
    median_depth = float(np.median(both.points_a[:, 2]))
    _check_poses(T_a_b, scale_pose(np.linalg.inv(T_b_a), np.exp(log_ratio)), median_depth, config)
    _check_spread(pairs.rows(fits), both.points_a, a.size, b.size, config)
    _check_scale(both, T_a_b, log_ratio, config)
    similarity = refine(pairs.rows(fits), T_a_b, log_ratio, config.refine)
    return Aligned(similarity, int(fits.sum()), median_depth)


def _matched(a: Keyframe, b: Keyframe, config: AlignmentConfig) -> Pairs:
    """Find mutual matches that fit one essential matrix."""
    rows_a, rows_b = mutual(unit_descriptors(a), unit_descriptors(b), config.max_ratio)
    require(Gate.MATCHES, len(rows_a) >= config.min_matches, len(rows_a))
    pairs = Pairs(
        *(np.float64(array) for array in (a.pixels[rows_a], b.pixels[rows_b], a.points[rows_a], b.points[rows_b])),
        *(calibration(keyframe.intrinsics) for keyframe in (a, b)),
    )
    # In pixels of one camera, because the essential matrix assumes two equal cameras.
    as_a = (pairs.pixels_b - pairs.K_b[:2, 2]) / pairs.K_b.diagonal()[:2] * pairs.K_a.diagonal()[:2] + pairs.K_a[:2, 2]
    _, mask = essential(pairs.pixels_a, as_a, pairs.K_a, config.max_epipolar_error)
    inliers = np.zeros(len(rows_a), bool) if mask is None else mask.ravel() > 0
    require(Gate.MATCHES, inliers.sum() >= config.min_matches, inliers.sum())
    require(Gate.MATCH_SHARE, inliers.mean() >= config.min_match_share, inliers.mean())
    return pairs.rows(inliers)


def _posed(
    points: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"], K: np.ndarray, config: AlignmentConfig
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, " n"]]:
    """Solve for T_points_camera of a camera that sees points at pixels, and find which (n,) fit."""
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    found = pose_of(points[known], pixels[known], K, MIN_POSE, config.max_reprojection_error)
    count = 0 if found is None else len(found[1])
    require(Gate.POSE, count >= config.min_pose_points, count)
    T, rows = found
    fits = np.zeros(len(points), bool)
    fits[known[rows]] = True
    return T, fits


def _depths(T_a_b: Float[np.ndarray, "4 4"], points_a: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Compute depths in camera b of points in frame a."""
    return (points_a - T_a_b[:3, 3]) @ T_a_b[:3, 2]


def _check_poses(one: np.ndarray, other: np.ndarray, median_depth: float, config: AlignmentConfig) -> None:
    distance, turn = pose_difference(one, other)
    require(Gate.POSES_DISAGREE, distance <= config.max_pose_gap * median_depth, distance)
    require(Gate.POSES_DISAGREE, turn <= config.max_pose_turn_deg, turn)


def _check_spread(
    pairs: Pairs,
    points: Float[np.ndarray, "n 3"],
    size_a: tuple[int, int],
    size_b: tuple[int, int],
    config: AlignmentConfig,
) -> None:
    """Refuse points that are close together or on a line, which do not determine the pose."""
    share = min(_hull_share(pairs.pixels_a, size_a), _hull_share(pairs.pixels_b, size_b))
    require(Gate.HULL, share >= config.min_hull, share)
    centred = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    flatness = spread[1] / max(spread[0], np.finfo(float).tiny)
    require(Gate.COLLINEAR, flatness >= config.min_flatness, flatness)
    extent = np.ptp(np.quantile(centred @ axes.T, [0.05, 0.95], axis=0), axis=0).max()
    require(Gate.SMALL, extent >= config.min_extent, extent)


def _hull_share(pixels: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> float:
    """Compute the area of the pixels' convex hull as a share of the image."""
    return cv2.contourArea(cv2.convexHull(np.float32(pixels))) / (size[0] * size[1])


def _check_scale(both: Pairs, T_a_b: np.ndarray, log_ratio: float, config: AlignmentConfig) -> None:
    ratios = log_ratios(both, T_a_b, log_ratio)
    scatter = MAD_TO_STD * np.median(np.abs(ratios - np.median(ratios)))
    require(Gate.DEPTHS, scatter <= config.max_depth_scatter, scatter)
    require(Gate.SCALE, abs(log_ratio) <= 3 * np.sqrt(2) * config.scale_std, log_ratio)
