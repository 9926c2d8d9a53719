"""The similarity between the cameras of two keyframes that show the same points, by robust least squares.

Each camera has predicted the points in its own frame and units: X_a = e^r R X_b + t. The residuals are reprojections of
either camera's points in the other (pixels), and the two depths of each point (which measure r and the distance).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from threadpoolctl import ThreadpoolController

from emgs_jax.geometry import transform_points
from emgs_jax.ops.constants import MAD_TO_STD
from emgs_jax.ops.ranges import number

HUBER = 1.345  # standard deviations: 95 % efficient for normal errors


@dataclass(frozen=True)
class RefineConfig:
    """Noise model of the two-view refinement: smallest residuals, their correlation, and smallest errors of the result.

    Args:
        min_pixel_std, min_depth_std: of residuals in pixels and log depth, at least.
        correlation: between the residuals of any two points, as depth errors are smooth: n points count as
            n / (1 + (n - 1) correlation).
        floor_translation, floor_rotation_deg, floor_log_ratio: standard deviations added to all results, in units of a,
            degrees, and of the log-ratio.
    """

    min_pixel_std: float = number(0.3, low=1e-6, high=1000)
    min_depth_std: float = number(0.005, low=1e-9, high=1000)
    correlation: float = number(0.05, low=0, high=1)
    floor_translation: float = number(0.01, low=0)
    floor_rotation_deg: float = number(0.3, low=0)
    floor_log_ratio: float = number(0.005, low=0)


@dataclass(frozen=True)
class Pairs:
    """The same points in two keyframes, row by row: their pixels and their predicted positions in both.

    Args:
        points_a, points_b: each in its own camera frame and units; NaN without depth.
    """

    pixels_a: Float[np.ndarray, "n 2"]
    pixels_b: Float[np.ndarray, "n 2"]
    points_a: Float[np.ndarray, "n 3"]
    points_b: Float[np.ndarray, "n 3"]
    K_a: Float[np.ndarray, "3 3"]
    K_b: Float[np.ndarray, "3 3"]

    def rows(self, chosen: np.ndarray) -> "Pairs":
        """Select some of the points."""
        arrays = (self.pixels_a, self.pixels_b, self.points_a, self.points_b)
        return Pairs(*(array[chosen] for array in arrays), self.K_a, self.K_b)


@dataclass(frozen=True)
class Similarity:
    """The similarity X_a = e^r R X_b + t and its covariance.

    Args:
        T_a_b: R and t; camera b -> camera a, in a's units.
        log_ratio: r, log-ratio of lengths: one that is e^r in a's inference is 1 in b's.
        covariance: of (translation, rotation, r), if the truth is T_a_b Exp(·) and r + ·.
    """

    T_a_b: Float[np.ndarray, "4 4"]
    log_ratio: float
    covariance: Float[np.ndarray, "7 7"]


def log_ratios(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float) -> Float[np.ndarray, "n"]:
    """Compute each point's log-ratio of a's depth to b's, averaged over both views; NaN if one has no depth.

    `log_ratio` only brings b's points into a's units when they are viewed from a.
    """
    from_b = transform_points(np.linalg.inv(T_a_b), pairs.points_a)[:, 2] / pairs.points_b[:, 2]
    from_a = pairs.points_a[:, 2] / transform_points(T_a_b, np.exp(log_ratio) * pairs.points_b)[:, 2]
    with np.errstate(invalid="ignore"):
        return 0.5 * (np.log(from_b) + np.log(from_a) + log_ratio)


def refine(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float, config: RefineConfig) -> Similarity:
    """Refine a similarity from a nearby start, with Huber's loss.

    Residuals are weighted by their own scatter, separately for pixels and depths; a first round measures it. The
    covariance is (JᵀJ)⁻¹ (1 + (n - 1) correlation) plus the floors.
    """
    stds = np.array([config.min_pixel_std, config.min_depth_std])
    floors = np.repeat([config.floor_translation, np.radians(config.floor_rotation_deg)], 3)
    floors = np.append(floors, config.floor_log_ratio)
    for _ in range(2):
        kinds = _kinds(pairs)

        def weighted(step, start=(T_a_b, log_ratio), std=stds[kinds]):
            return _errors(pairs, *perturbed(*start, step)) / std

        with _libraries().limit(limits=1, user_api="blas"):  # for seven unknowns, threads cost more than they gain
            found = least_squares(weighted, np.zeros(7), loss="huber", f_scale=HUBER, x_scale="jac")
        T_a_b, log_ratio = perturbed(T_a_b, log_ratio, found.x)
        errors = np.abs(_errors(pairs, T_a_b, log_ratio))
        scatter = [MAD_TO_STD * np.median(errors[kinds == kind]) for kind in (0, 1)]
        stds = np.maximum(scatter, [config.min_pixel_std, config.min_depth_std])
    inflation = 1 + (len(pairs.pixels_a) - 1) * config.correlation
    covariance = inflation * np.linalg.inv(found.jac.T @ found.jac) + np.diag(floors**2)
    return Similarity(T_a_b, float(log_ratio), covariance)


@cache
def _libraries() -> ThreadpoolController:
    """Find the multithreaded libraries that this process has loaded, such as BLAS."""
    return ThreadpoolController()


def perturbed(
    T_a_b: Float[np.ndarray, "4 4"], log_ratio: float, step: Float[np.ndarray, "7"]
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Apply T (I + step) to first order, with an exact rotation; order and side as in `jaxlie`."""
    T_step = np.eye(4)
    T_step[:3, :3], T_step[:3, 3] = Rotation.from_rotvec(step[3:6]).as_matrix(), step[:3]
    return T_a_b @ T_step, log_ratio + step[6]


def _has_points(pairs: Pairs) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    return np.isfinite(pairs.points_a[:, 2]), np.isfinite(pairs.points_b[:, 2])


def _kinds(pairs: Pairs) -> np.ndarray:
    """Tell the kind of each of `_errors`: 0 pixels, 1 log depth."""
    in_a, in_b = _has_points(pairs)
    return np.repeat([0, 1], [2 * in_a.sum() + 2 * in_b.sum(), (in_a & in_b).sum()])


def _errors(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float) -> Float[np.ndarray, " r"]:
    """Compute residuals: pixels of b and of a, for the other's points; then log depth of points that both have."""
    in_a, in_b = _has_points(pairs)
    seen_by_b = transform_points(np.linalg.inv(T_a_b), pairs.points_a[in_a])
    seen_by_a = transform_points(T_a_b, np.exp(log_ratio) * pairs.points_b[in_b])
    in_pixels = [
        (_project(seen_by_b, pairs.K_b) - pairs.pixels_b[in_a]).ravel(),
        (_project(seen_by_a, pairs.K_a) - pairs.pixels_a[in_b]).ravel(),
    ]
    both = in_a & in_b
    return np.concatenate([*in_pixels, log_ratios(pairs.rows(both), T_a_b, log_ratio) - log_ratio])


def _project(points: Float[np.ndarray, "n 3"], K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 2"]:
    return (points @ K.T)[:, :2] / points[:, 2:]
