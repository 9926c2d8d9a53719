"""Estimate the error of given poses from the epipolar errors of points that two frames share."""

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from emgs_jax.data.base import BadFrameError, Dataset
from emgs_jax.keypoints.poses import calibration, essential
from emgs_jax.keypoints.sift import detect, mutual
from emgs_jax.ops.constants import MAD_TO_STD

GAPS, NUM_PAIRS = (1, 4, 16), 6  # frames between a pair, and pairs with each gap
NUM_FEATURES, MIN_CONTRAST, MAX_RATIO = 1500, 0.02, 0.8
MAX_ERROR = 2.0  # pixels, of an inlier
MIN_MATCHES, MIN_PAIRS = 40, 3  # in a pair, and with one gap


def pose_angle(dataset: Dataset, T_world_cameras: Mapping[int, np.ndarray]) -> float | None:
    """Standard deviation σ (rad) per axis of each pose's rotation, and of its position relative to the scene's depth.

    The epipolar error e of a match is e² = noise² + 4 f² σ², with the keypoints' noise, which remains for the best
    pose, and rotations and positions of both views in error by σ. Drift shows in frames farther apart, so the gap with
    the largest σ counts. The length of a motion does not show. None if too few pairs share enough points.
    """
    of_gaps = [[*_errors(dataset, T_world_cameras, gap)] for gap in GAPS]
    found = [float(np.median(errors)) for errors in of_gaps if len(errors) >= MIN_PAIRS]
    return max(found) / (2.0 * dataset.intrinsics[0]) if found else None


def _errors(dataset: Dataset, T_world_cameras: Mapping[int, np.ndarray], gap: int) -> Iterator[float]:
    """`pair_error` of pairs of frames, evenly spread over the sequence."""
    known = sorted(T_world_cameras)
    pairs = [*zip(known, known[gap:], strict=False)]
    for row in np.unique(np.linspace(0, len(pairs) - 1, NUM_PAIRS).astype(int)) if pairs else ():
        a, b = pairs[row]
        try:
            images = [dataset[index].image for index in (a, b)]
        except BadFrameError:
            continue
        T_b_a = np.linalg.inv(T_world_cameras[b]) @ T_world_cameras[a]
        error = pair_error(images, T_b_a, dataset.intrinsics)
        if error is not None:
            yield error


def pair_error(
    images: Sequence[np.ndarray], T_b_a: Float[np.ndarray, "4 4"], intrinsics: Sequence[float]
) -> float | None:
    """Epipolar error (pixels) of two images due to their relative pose; None if they share too little.

    It includes the error that the keypoints' noise may cause, so that it is never 0.
    """
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    (a, of_a), (b, of_b) = (detect(image, NUM_FEATURES, MIN_CONTRAST) for image in gray)
    (rows_a, rows_b), K = mutual(of_a, of_b, MAX_RATIO), calibration(intrinsics)
    x, y, z = T_b_a[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if len(rows_a) < MIN_MATCHES or not across.any():
        return None
    best, is_inlier = essential(a[rows_a], b[rows_b], K, MAX_ERROR)
    if best is None or best.shape != (3, 3) or np.sum(is_inlier) < MIN_MATCHES:
        return None
    pairs = a[rows_a][is_inlier.ravel() > 0], b[rows_b][is_inlier.ravel() > 0]
    given_sq, noise_sq = (
        (MAD_TO_STD * np.median(np.abs(sampson(E, *pairs, K)))) ** 2 for E in (across @ T_b_a[:3, :3], best)
    )
    return float(np.sqrt(max(given_sq - noise_sq, 0.0) + noise_sq / len(pairs[0])))


def sampson(
    E_b_a: Float[np.ndarray, "3 3"],
    a: Float[np.ndarray, "n 2"],
    b: Float[np.ndarray, "n 2"],
    K: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, " n"]:
    """Signed Sampson errors (pixels) of matched pixels, by the epipolar constraint b' E a = 0."""
    F = np.linalg.inv(K).T @ E_b_a @ np.linalg.inv(K)
    a, b = (np.column_stack([pixels, np.ones(len(pixels))]) for pixels in (a, b))
    lines_b, lines_a = a @ F.T, b @ F
    return np.sum(b * lines_b, axis=1) / np.sqrt(np.sum(lines_b[:, :2] ** 2 + lines_a[:, :2] ** 2, axis=1))
