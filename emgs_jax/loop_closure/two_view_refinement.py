"""The similarity between the cameras of two keyframes that show the same points, by robust least squares.

Each camera has predicted the points in its own frame and units: X_a = e^r R X_b + t. All four say something: the points
of either seen by the other (pixels), and the two depths of one point (r, and the distance).
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

HUBER = 1.345  # standard deviations: 95 % efficient where all is normal


@dataclass(frozen=True)
class RefineConfig:
    """Noise model of the two-view refinement: least residuals, their correlation, and least errors of the result.

    Args:
        min_pixel_std, min_depth_std: of residuals in pixels and log depth, at least.
        correlation: between the residuals of any two points: errors of a predicted depth are smooth, so n points count
            as n / (1 + (n - 1) correlation).
        floor_translation, floor_rotation_deg, floor_log_ratio: standard deviations that all results have besides, in
            units of a, degrees, and of the log-ratio.
    """

    min_pixel_std: float = number(0.3, low=1e-6, high=1000)
    min_depth_std: float = number(0.005, low=1e-9, high=1000)
    correlation: float = number(0.05, low=0, high=1)
    floor_translation: float = number(0.01, low=0)
    floor_rotation_deg: float = number(0.3, low=0)
    floor_log_ratio: float = number(0.005, low=0)


@dataclass(frozen=True)
class Pairs:
    """The same points in two keyframes, row by row: where each shows them and where each takes them to be.

    Args:
        points_a, points_b: in either camera's frame and units; NaN without depth.
    """

    pixels_a: Float[np.ndarray, "n 2"]
    pixels_b: Float[np.ndarray, "n 2"]
    points_a: Float[np.ndarray, "n 3"]
    points_b: Float[np.ndarray, "n 3"]
    K_a: Float[np.ndarray, "3 3"]
    K_b: Float[np.ndarray, "3 3"]

    def rows(self, chosen: np.ndarray) -> "Pairs":
        """Some of the points."""
        arrays = (self.pixels_a, self.pixels_b, self.points_a, self.points_b)
        return Pairs(*(array[chosen] for array in arrays), self.K_a, self.K_b)


@dataclass(frozen=True)
class Similarity:
    """X_a = e^r R X_b + t, and how well it is known.

    Args:
        T_a_b: R and t; camera b -> camera a, in a's units.
        log_ratio: r, log of a's unit over b's: what a's inference gives as e^r, b's gives as 1.
        covariance: of (translation, rotation, r) where the truth is T_a_b Exp(·) and r + ·.
    """

    T_a_b: Float[np.ndarray, "4 4"]
    log_ratio: float
    covariance: Float[np.ndarray, "7 7"]


def log_ratios(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float) -> Float[np.ndarray, "n"]:
    """log of a's depth over b's of each point, the mean of what it is seen from b and from a; NaN where one has none.

    `log_ratio` only brings b's points into a's units where they are seen from a.
    """
    from_b = transform_points(np.linalg.inv(T_a_b), pairs.points_a)[:, 2] / pairs.points_b[:, 2]
    from_a = pairs.points_a[:, 2] / transform_points(T_a_b, np.exp(log_ratio) * pairs.points_b)[:, 2]
    with np.errstate(invalid="ignore"):
        return 0.5 * (np.log(from_b) + np.log(from_a) + log_ratio)


def refine(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float, config: RefineConfig) -> Similarity:
    """The similarity that fits best from one nearby, Huber's loss.

    Residuals are weighted by their own scatter, pixels and depths each: a first round measures it. The covariance is
    (JᵀJ)⁻¹ (1 + (n - 1) correlation) and the floors.
    """
    stds = np.array([config.min_pixel_std, config.min_depth_std])
    floors = np.repeat([config.floor_translation, np.radians(config.floor_rotation_deg)], 3)
    floors = np.append(floors, config.floor_log_ratio)
    for _ in range(2):
        kinds = _kinds(pairs)

        def weighted(step, start=(T_a_b, log_ratio), std=stds[kinds]):
            return _errors(pairs, *perturbed(*start, step)) / std

        with _libraries().limit(limits=1, user_api="blas"):  # for seven unknowns threads cost more than they do
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
    """The libraries with threads that this process has loaded, BLAS among them."""
    return ThreadpoolController()


def perturbed(
    T_a_b: Float[np.ndarray, "4 4"], log_ratio: float, step: Float[np.ndarray, "7"]
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """T (I + step) to first order, its rotation exact: the order and side of `jaxlie`'s tangents."""
    T_step = np.eye(4)
    T_step[:3, :3], T_step[:3, 3] = Rotation.from_rotvec(step[3:6]).as_matrix(), step[:3]
    return T_a_b @ T_step, log_ratio + step[6]


def _has_points(pairs: Pairs) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    return np.isfinite(pairs.points_a[:, 2]), np.isfinite(pairs.points_b[:, 2])


def _kinds(pairs: Pairs) -> np.ndarray:
    """Of each of `_errors`: 0 pixels, 1 log depth."""
    in_a, in_b = _has_points(pairs)
    return np.repeat([0, 1], [2 * in_a.sum() + 2 * in_b.sum(), (in_a & in_b).sum()])


def _errors(pairs: Pairs, T_a_b: Float[np.ndarray, "4 4"], log_ratio: float) -> Float[np.ndarray, " r"]:
    """In pixels of b, then of a, of the points that the other has; then in log depth where both have one."""
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
