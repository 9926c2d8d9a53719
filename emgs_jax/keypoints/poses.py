"""Poses from keypoints: of two images that show the same, and of an image that shows known points (OpenCV)."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int


def calibration(intrinsics: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """The matrix K of fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def essential(
    a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"], K: Float[np.ndarray, "3 3"], max_error: float
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Essential matrix of matched pixels, and which (n, 1) fit within `max_error` pixels (MAGSAC++); None for none."""
    return cv2.findEssentialMat(a, b, K, method=cv2.USAC_MAGSAC, prob=0.9999, threshold=max_error, maxIters=2000)


def pose_of(
    points: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    K: Float[np.ndarray, "3 3"],
    least: int,
    max_error: float,
) -> tuple[Float[np.ndarray, "4 4"], Int[np.ndarray, " k"]] | None:
    """T_ref_view from points of the reference frame at a view's pixels (PnP with MAGSAC++), and the rows that fit.

    Args:
        least: rows that must fit; None with fewer.
        max_error: of a row that fits, pixels.
    """
    if len(points) < least:
        return None
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = max_error, 0.9999, 2000
    params.score, params.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.randomGeneratorState = cv2.LOCAL_OPTIM_SIGMA, 0
    found, _, rotation, translation, inliers = cv2.solvePnPRansac(
        points.reshape(-1, 1, 3), pixels.reshape(-1, 1, 2), K.copy(), None, params=params
    )
    if not found or inliers is None or len(inliers) < least:
        return None
    rows = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, rotation, translation)
    T_view_ref = np.eye(4)
    T_view_ref[:3, :3], T_view_ref[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return np.linalg.inv(T_view_ref), rows
