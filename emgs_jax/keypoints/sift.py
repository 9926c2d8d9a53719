"""Keypoints of an image with descriptors, and which of two images are the same (OpenCV)."""

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

DESCRIPTOR_SIZE = 128


def detect(
    gray: np.ndarray, num_features: int, min_contrast: float
) -> tuple[Float[np.ndarray, "n 2"], Float32[np.ndarray, "n 128"]]:
    """SIFT keypoints with the square roots of their normalised descriptors (Arandjelović and Zisserman, CVPR 2012).

    Args:
        gray: uint8 (h, w).

    Returns:
        pixels, centres at integers, and unit descriptors; none for a blank image.
    """
    detector = cv2.SIFT_create(nfeatures=num_features, contrastThreshold=min_contrast, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, DESCRIPTOR_SIZE), np.float32)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return np.array([point.pt for point in keypoints]), np.sqrt(descriptors / total)


def mutual(
    a: Float32[np.ndarray, "n d"], b: Float32[np.ndarray, "m d"], max_ratio: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows of the unit descriptors `a` and `b` that are each other's nearest, distinctly so in `b`.

    Args:
        max_ratio: distance to the best descriptor over that to the second (Lowe, IJCV 2004).
    """
    if not len(a) or len(b) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    similarity = a @ b.T
    row, nearest = np.arange(len(a)), similarity.argmax(axis=1)
    best = similarity[row, nearest]
    rows = np.flatnonzero(best == similarity.max(axis=0)[nearest])  # a tenth of the time of argmax along columns
    rows = rows[np.sort(np.unique(nearest[rows], return_index=True)[1])]  # of equal ones the first
    similarity[row, nearest] = -np.inf
    # Of unit vectors |d|² = 2 - 2 cos.
    rows = rows[1 - best[rows] < max_ratio**2 * (1 - similarity[rows].max(axis=1))]
    return rows, nearest[rows]
