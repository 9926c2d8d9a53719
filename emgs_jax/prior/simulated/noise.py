"""Seeded random numbers, fields, motions and confused classes for the `simulated` prior.

Draws depend only on their `key` (seed, stream, inference, frames…), never on earlier calls.
"""

import math
from enum import IntEnum

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

CELL = 2.0  # m between places with independent confusions
SECTORS = 2.0  # steps per unit of the viewing direction's coordinates: about 30°
OFFSET = 2**20  # keys must not be negative


class Stream(IntEnum):
    """Random streams by purpose."""

    DRIFT = 1
    PAIR = 2
    PIXEL = 3
    FLYING = 4
    CONFIDENCE = 5
    FEATURE = 6
    WARP = 7  # one for each correlation length: WARP, WARP + 1, …
    SCALE = 100  # beyond all warps
    CONFUSION = 101


def normals(shape: tuple[int, ...], key: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(key).standard_normal(shape, np.float32)


def shared_normals(
    shape: tuple[int, ...], key: tuple[int, int, int, *tuple[int, ...]], image_share: float
) -> np.ndarray:
    """Unit-variance normals, of whose variance `image_share` is the same in every inference."""
    seed, stream, inference, *frames = key
    of_images = normals(shape, (seed, stream, 0, *frames))
    of_inference = normals(shape, (seed, stream, inference + 1, *frames))
    return np.float32(math.sqrt(image_share)) * of_images + np.float32(math.sqrt(1 - image_share)) * of_inference


def autoregressive(seed: int, inference: int, correlation: float, size: int) -> np.ndarray:
    """The state (size,) at `inference` of stationary unit-variance AR(1) processes, from the start of one stream."""
    innovations = np.random.default_rng((seed, Stream.DRIFT)).standard_normal((inference + 1, size))
    weights = correlation ** np.arange(inference, -1.0, -1.0)
    weights[1:] *= math.sqrt(1 - correlation**2)
    return (weights[:, None] * innovations).sum(axis=0)


def random_walk(seed: int, inference: int) -> float:
    """The state at `inference` of a standard normal random walk from 0, from the start of one stream."""
    return float(np.random.default_rng((seed, Stream.SCALE)).standard_normal(inference).sum())


def rigid(xi: np.ndarray, translation: float, rotation: float) -> np.ndarray:
    """The rigid motion (4, 4) of `xi` (v, ω), v times `translation` and ω times `rotation`."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation * np.asarray(xi[3:], np.float64)).as_matrix()
    T[:3, 3] = translation * np.asarray(xi[:3], np.float64)
    return T


def smooth_field(shape: tuple[int, int], length: float, key: tuple[int, ...], image_share: float) -> np.ndarray:
    """A unit-variance Gaussian field (h, w), float32, with correlation exp(-r²/2·length²), r in pixels."""
    rows, columns = (gaussian_weights(n, length / math.sqrt(2)) for n in shape)
    noise = shared_normals((rows.shape[1], columns.shape[1]), key, image_share)  # white, filtered by a Gaussian
    # einsum and not @, whose sums depend on the number of BLAS threads.
    return np.einsum("hj,wj->hw", np.einsum("hi,ji->hj", rows, np.ascontiguousarray(noise.T)), columns)


def gaussian_weights(size: int, sigma: float) -> np.ndarray:
    """Weights (size, knots), float32, of knots `sigma` apart; the squares of each row sum to 1."""
    knots = sigma * np.arange(-4, math.ceil((size - 1) / sigma) + 5)
    weights = np.exp(-0.5 * ((np.arange(size)[:, None] - knots) / sigma) ** 2)
    return (weights / np.linalg.norm(weights, axis=1, keepdims=True)).astype(np.float32)


def edge_band(depth: np.ndarray, step: float) -> np.ndarray:
    """The valid pixels (h, w) within 2 px of a relative depth step of more than `step`, two on each side."""
    beside = np.zeros(depth.shape, np.uint8)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        low, high = np.minimum(depth[a], depth[b]), np.maximum(depth[a], depth[b])
        is_step = (low > 0) & (high > (1 + step) * low)
        beside[a] |= is_step
        beside[b] |= is_step
    return (cv2.dilate(beside, np.ones((3, 3), np.uint8)) > 0) & (depth > 0)


def confused(
    labels: Int[np.ndarray, "h w"], T_world_camera: Float[np.ndarray, "4 4"], num_classes: int, share: float, seed: int
) -> Int[np.ndarray, "h w"]:
    """The labels as seen from one place in one direction, where each class is another with probability `share`.

    All pixels of a class, and all frames of one cell and sector, err together; other views are independent. -1 stays.
    """
    if share <= 0:
        return labels
    place = np.rint(T_world_camera[:3, 3] / CELL)
    view = np.rint(SECTORS * T_world_camera[:3, 2])
    key = (np.concatenate([place, view]) + OFFSET).astype(int).tolist()
    rng = np.random.default_rng((seed, Stream.CONFUSION, *key))
    taken_for = np.where(
        rng.random(num_classes) < share, rng.integers(num_classes, size=num_classes), range(num_classes)
    )
    return np.append(taken_for, -1)[labels].astype(labels.dtype)
