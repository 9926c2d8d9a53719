"""Relocalization: find the pose of a camera that is lost, or new in a saved map, among keyframes with known poses.

Since nothing is known about the pose, every keyframe of similar appearance is a candidate. Each is verified on its own.
The best one gives the pose, unless another verified candidate implies a different one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from emgs_jax.geometry import pose_difference, scale_covariance, scale_pose
from emgs_jax.loop_closure.place_recognition import Database, Keyframe, PlaceRecognitionConfig, most_similar
from emgs_jax.loop_closure.two_view_alignment import Gate
from emgs_jax.loop_closure.verification import LoopMeasurement, VerificationConfig, neighbours_of, verify
from emgs_jax.ops.ranges import number

NO_CANDIDATE, AMBIGUOUS = "no_candidate", "ambiguous"  # reasons of a rejection beside the gates of two keyframes


@dataclass(frozen=True)
class RelocalizationConfig:
    """Settings of relocalization: when it is attempted, and when its result is accepted.

    Args:
        patience: untracked frames in a row after which relocalization is attempted.
        max_patience: likewise, after which the map restarts at the pose that the prior predicts, if relocalization
            still fails. inf: never.
        num_candidates: keyframes to verify, each from another time span.
        max_distance: between the positions that two candidates imply, as a fraction of the distance of the points that
            the camera sees.
        min_inliers: of the best candidate.
        min_inlier_fraction: of the points that fit the map when the pose is refined in it.
        max_step: between the pose by the keyframe and that by the map, as a fraction of the mean depth.
    """

    patience: int = number(3, low=1)
    max_patience: float = number(3.0, low=1, high=math.inf)
    num_candidates: int = number(10, low=1, high=1000)
    max_distance: float = number(0.1, low=0, high=math.inf)
    max_turn_deg: float = number(5.0, low=0, high=math.inf)
    min_inliers: int = number(40, low=0)
    min_inlier_fraction: float = number(0.5, low=0, high=1)
    max_step: float = number(0.05, low=0, high=math.inf)
    max_step_deg: float = number(3.0, low=0, high=180)


@dataclass(frozen=True)
class PosedKeyframes:
    """Keyframes with their poses; poses and the rest are indexed by the keyframes' numbers.

    Args:
        poses: T_world_camera (4, 4).
        log_scales: σ: a length of the inference times e^σ is one of the map.
    """

    database: Database
    poses: Sequence[np.ndarray]
    log_scales: Sequence[float]
    is_placed: Sequence[bool]


@dataclass(frozen=True)
class RelocalizedPose:
    """Pose of a camera, found by relocalization.

    Args:
        log_scale: σ of its inference.
        covariance: of (translation, rotation, σ) where the truth is T Exp(·), lengths of the map.
        keyframe: number of the keyframe by which it was found.
    """

    T_world_camera: Float[np.ndarray, "4 4"]
    log_scale: float
    covariance: Float[np.ndarray, "7 7"]
    keyframe: int


def relocalize(
    query: Keyframe,
    known: PosedKeyframes,
    appearance: PlaceRecognitionConfig,
    verification: VerificationConfig,
    config: RelocalizationConfig,
) -> tuple[RelocalizedPose | None, str | None]:
    """Relocalize a keyframe among others: return its pose, or None and the gate or reason that rejected it."""
    keyframes = known.database.keyframes
    rows = [row for row, one in enumerate(keyframes) if known.is_placed[one.frame]]
    candidates = most_similar(known.database, query, rows, config.num_candidates, appearance)
    if not candidates:
        return None, NO_CANDIDATE
    alone = replace(verification, min_neighbours=0)
    results = [(row, *verify(query, keyframes[row], (), alone)) for row in candidates]
    verified = sorted(((row, loop) for row, loop, _ in results if loop), key=lambda found: -found[1].num_inliers)
    if not verified:
        return None, max((info.refused_by for *_, info in results), key=list(Gate).index)
    row, best = verified[0]
    if best.num_inliers < config.min_inliers:
        return None, Gate.MATCHES
    candidate = keyframes[row]
    by_time = sorted((keyframes[other] for other in rows), key=lambda other: abs(other.frame - candidate.frame))
    neighbours = neighbours_of(candidate, by_time[1:3], known.poses, known.log_scales)
    loop, info = verify(query, candidate, neighbours, verification)
    if loop is None:
        return None, info.refused_by
    found, depth = _query_pose(loop, known), np.nanmedian(query.points[:, 2])

    def agrees(other: LoopMeasurement) -> bool:
        there = _query_pose(other, known)
        distance, turn = pose_difference(there.T_world_camera, found.T_world_camera)
        allowed = config.max_distance * depth * np.exp(found.log_scale)
        return bool(distance <= allowed and turn <= config.max_turn_deg)

    if not all(agrees(other) for _, other in verified):
        return None, AMBIGUOUS
    violations = [info.violation for *_, info in results if info.violation is not None]
    if sum(agrees(other) for other in violations) >= len(verified):
        return None, Gate.FREE_SPACE
    return found, None


def _query_pose(loop: LoopMeasurement, known: PosedKeyframes) -> RelocalizedPose:
    """Return the pose of a loop's query in the world, by the pose and scale of its candidate."""
    scale = np.exp(known.log_scales[loop.a])
    covariance = scale_covariance(np.linalg.inv(loop.sqrt_info.T @ loop.sqrt_info), scale)
    pose = known.poses[loop.a] @ scale_pose(loop.Z_a_b, scale)
    return RelocalizedPose(pose, known.log_scales[loop.a] + loop.log_ratio, covariance, loop.a)
