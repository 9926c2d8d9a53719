"""Second measurement of a loop: one prediction of the prior with views of both visits.

A feed-forward model predicts relative poses of images without knowing the path between them, however far apart in time
they were taken. Keypoints have found the loop; the prediction is an independent measurement, which confirms or rejects
it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial.transform import Rotation

from emgs_jax.geometry import scale_pose
from emgs_jax.loop_closure.place_recognition import Keyframe, sampled_depths
from emgs_jax.loop_closure.two_view_refinement import Similarity, perturbed
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class PriorQueryConfig:
    """Second measurement of loops by the prior: whether to make it, from which views, and its standard deviations.

    Args:
        is_used: measure loops that violate the poses in this way, too, if the prior can predict both visits.
        max_queries: how many loops of a closure are measured: those with most inliers, each of another query.
        spacing: frames between either visit's frame and the neighbouring frames that the prior also sees.
        std, std_share: per axis of the translation between the visits: in units of the earlier one, and as a share of
            its length.
        std_deg: of the rotation, about each axis.
        log_ratio_std: of the log-ratio of the units of the loop's two inferences.
        min_cells: cells of the depth grid that each image must share with its own inference.
        max_misfit: χ² (seven degrees of freedom) between the two measurements of a loop beyond which it is refused.
    """

    is_used: bool = True
    max_queries: int = number(3, low=1, high=1000)
    spacing: int = number(3, low=1, high=1000)
    std: float = number(0.03, low=1e-6, high=1000)
    std_share: float = number(0.02, low=0, high=10)
    std_deg: float = number(1.0, low=1e-6, high=180)
    log_ratio_std: float = number(0.02, low=1e-6, high=10)
    min_cells: int = number(100, low=1)
    max_misfit: float = number(24.3, low=0, high=math.inf)  # χ²₇ at 99.9 %


@dataclass(frozen=True)
class JointPrediction:
    """Prediction of one inference that sees both visits of a place, in its own unit.

    Args:
        T_a_b: camera b -> camera a; not finite if it is not predicted.
        points: of a and of b, each in its own camera frame.
    """

    T_a_b: Float[np.ndarray, "4 4"]
    points: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]
    masks: tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]


PriorQuery = Callable[[int, int], JointPrediction | None]  # of two frames, the earlier first; None without an answer


def measure_by_prior(joint: JointPrediction, a: Keyframe, b: Keyframe, config: PriorQueryConfig) -> Similarity | None:
    """Measure the similarity between two keyframes' inferences by an inference that sees both visits.

    It has a unit of its own, which the depths of a and b relate to theirs: e^{ρ_x} = median z'_x / z_x. So
    t = e^{-ρ_a} t', and the log-ratio of a's unit to b's is ρ_b - ρ_a.

    Returns:
        The similarity in units of a, with a diagonal covariance; None if the inference has no pose or too few depths.
    """
    if not np.isfinite(joint.T_a_b).all():
        return None
    ratios = []
    for keyframe, points, mask in zip((a, b), joint.points, joint.masks, strict=True):
        new, own = np.float64(sampled_depths(points, mask, keyframe.depths.shape[::-1])), np.float64(keyframe.depths)
        both = (new > 0) & (own > 0) & np.isfinite(new) & np.isfinite(own)
        if both.sum() < config.min_cells:
            return None
        ratios.append(float(np.median(np.log(new[both] / own[both]))))
    T_a_b = scale_pose(joint.T_a_b, np.exp(-ratios[0]))
    std = config.std + config.std_share * np.linalg.norm(T_a_b[:3, 3])
    stds = [std] * 3 + [np.radians(config.std_deg)] * 3 + [config.log_ratio_std]
    return Similarity(T_a_b, ratios[1] - ratios[0], np.diag(np.square(stds)))


def fuse_measurements(loop: LoopMeasurement, other: Similarity) -> tuple[LoopMeasurement, float]:
    """Fuse two measurements of a loop, weighted by their information; also return χ² of their difference.

    With e = Log(Z⁻¹ Z') to first order, Λ = WᵀW + Σ'⁻¹ and ξ = Λ⁻¹ Σ'⁻¹ e the loop is at Z Exp(ξ), and
    χ² = eᵀ (Σ + Σ')⁻¹ e.
    """
    gap = np.linalg.inv(loop.Z_a_b) @ other.T_a_b
    error = np.array([*gap[:3, 3], *Rotation.from_matrix(gap[:3, :3]).as_rotvec(), other.log_ratio - loop.log_ratio])
    own, theirs = loop.sqrt_info.T @ loop.sqrt_info, np.linalg.inv(other.covariance)
    misfit = float(error @ np.linalg.solve(np.linalg.inv(own) + other.covariance, error))
    information = own + theirs
    Z_a_b, log_ratio = perturbed(loop.Z_a_b, loop.log_ratio, np.linalg.solve(information, theirs @ error))
    sqrt_info = np.linalg.cholesky(information).T
    return replace(loop, Z_a_b=Z_a_b, log_ratio=float(log_ratio), sqrt_info=sqrt_info), misfit
