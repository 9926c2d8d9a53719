"""A loop, measured once more: by one inference that sees views of both visits.

A feed-forward model sees images together however far apart in time they were taken, and says how they are to each other
without the path between them. Keypoints found the loop; what the prior says is a second measurement of it, with errors
of its own, or an objection.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial.transform import Rotation

from emgs_jax.loops.appearance import Keyframe, sampled_depths
from emgs_jax.loops.two_views import Similarity, moved_by_step, rescaled
from emgs_jax.loops.verification import LoopMeasurement
from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class RevisitConfig:
    """Second measurement of loops by the prior: whether it is made, on which views, and its standard deviations.

    Args:
        is_asked: measure loops that are to move the poses in this way, too, where the prior can predict both visits.
        num_asked: loops of a closure that are measured, each of another query, those with most inliers.
        spacing: frames between the two visits' frames and the neighbouring ones that the prior sees as well.
        std, std_share: of each axis of the pose between the two visits: in units of the earlier one, and of its length.
        std_deg: of its rotation, about each axis.
        log_ratio_std: of the ratio of the units of the two inferences that the loop is between.
        min_cells: of the grid of depths that an image of either must have in common with its own inference.
        max_misfit: χ² of the two measurements of a loop, of seven degrees of freedom, beyond which it is refused.
    """

    is_asked: bool
    num_asked: int = number(low=1, high=1000)
    spacing: int = number(low=1, high=1000)
    std: float = number(low=1e-6, high=1000)
    std_share: float = number(low=0, high=10)
    std_deg: float = number(low=1e-6, high=180)
    log_ratio_std: float = number(low=1e-6, high=10)
    min_cells: int = number(low=1)
    max_misfit: float = number(low=0, high=math.inf)


@dataclass(frozen=True)
class Revisit:
    """Prediction of one inference that shows both visits of a place, in its own unit.

    Args:
        T_a_b: camera b -> camera a; not finite where the prior does not know.
        points: of a and of b, each in its own camera's frame.
        masks: of these.
    """

    T_a_b: Float[np.ndarray, "4 4"]
    points: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]
    masks: tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]


Ask = Callable[[int, int], Revisit | None]  # of two frames, the earlier first; None where the prior does not say


def measured_again(told: Revisit, a: Keyframe, b: Keyframe, config: RevisitConfig) -> Similarity | None:
    """Measure the similarity between two keyframes' inferences by an inference that shows both visits.

    Its unit is neither's: the depths of a and b stand in both, e^{ρ_x} = median z'_x / z_x. So t = e^{-ρ_a} t', and the
    ratio of a's unit to b's is ρ_b - ρ_a.

    Returns:
        The similarity in units of a, its covariance diagonal; None where the inference has no pose, or too few depths.
    """
    if not np.isfinite(told.T_a_b).all():
        return None
    ratios = []
    for keyframe, points, mask in zip((a, b), told.points, told.masks, strict=True):
        new, own = np.float64(sampled_depths(points, mask, keyframe.depths.shape[::-1])), np.float64(keyframe.depths)
        both = (new > 0) & (own > 0) & np.isfinite(new) & np.isfinite(own)  # float16 ends at 65504
        if both.sum() < config.min_cells:
            return None
        ratios.append(float(np.median(np.log(new[both] / own[both]))))
    T_a_b = rescaled(told.T_a_b, np.exp(-ratios[0]))
    std = config.std + config.std_share * np.linalg.norm(T_a_b[:3, 3])
    stds = [std] * 3 + [np.radians(config.std_deg)] * 3 + [config.log_ratio_std]
    return Similarity(T_a_b, ratios[1] - ratios[0], np.diag(np.square(stds)))


def combined(loop: LoopMeasurement, other: Similarity) -> tuple[LoopMeasurement, float]:
    """A loop by two measurements of it, weighted by their information; and χ² of their difference.

    With e = Log(Z⁻¹ Z') to first order, Λ = WᵀW + Σ'⁻¹ and ξ = Λ⁻¹ Σ'⁻¹ e the loop is at Z Exp(ξ), and
    χ² = eᵀ (Σ + Σ')⁻¹ e.
    """
    gap = np.linalg.inv(loop.Z_a_b) @ other.T_a_b
    error = np.array([*gap[:3, 3], *Rotation.from_matrix(gap[:3, :3]).as_rotvec(), other.log_ratio - loop.log_ratio])
    own, theirs = loop.sqrt_info.T @ loop.sqrt_info, np.linalg.inv(other.covariance)
    misfit = float(error @ np.linalg.solve(np.linalg.inv(own) + other.covariance, error))
    information = own + theirs
    Z_a_b, log_ratio = moved_by_step(loop.Z_a_b, loop.log_ratio, np.linalg.solve(information, theirs @ error))
    sqrt_info = np.linalg.cholesky(information).T
    return replace(loop, Z_a_b=Z_a_b, log_ratio=float(log_ratio), sqrt_info=sqrt_info), misfit
