"""Seeded random numbers, fields, motions and mistaken classes that the `simulated` prior is made of.

A `key` is (seed, stream, inference, frames…): what is drawn depends on it only, never on earlier calls.
"""

import math
from enum import IntEnum

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

CELL = 2.0  # m between places from which it errs differently
SECTORS = 2.0  # steps of the viewing direction's coordinates in a unit: about 30° apart
OFFSET = 2**20  # random streams have no negative keys


class Stream(IntEnum):
    """Purposes of random streams; each is part of its stream's seed."""

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
    """Return standard normal float32 numbers that depend on `key` only."""
    return np.random.default_rng(key).standard_normal(shape, np.float32)


def shared_normals(
    shape: tuple[int, ...], key: tuple[int, int, int, *tuple[int, ...]], image_share: float
) -> np.ndarray:
    """Return unit-variance normals of which `image_share` of the variance is the same in every inference.

    `key` is (seed, stream, inference, frames…).
    """
    seed, stream, inference, *frames = key
    of_images = normals(shape, (seed, stream, 0, *frames))
    of_inference = normals(shape, (seed, stream, inference + 1, *frames))
    return np.float32(math.sqrt(image_share)) * of_images + np.float32(math.sqrt(1 - image_share)) * of_inference


def autoregressive(seed: int, inference: int, correlation: float, size: int) -> np.ndarray:
    """Return the state (size,) at `inference` of unit-variance stationary AR(1) processes.

    The innovations are one stream whose beginning does not depend on its length, so no state is kept between calls.
    """
    innovations = np.random.default_rng((seed, Stream.DRIFT)).standard_normal((inference + 1, size))
    weights = correlation ** np.arange(inference, -1.0, -1.0)
    weights[1:] *= math.sqrt(1 - correlation**2)
    return (weights[:, None] * innovations).sum(axis=0)


def random_walk(seed: int, inference: int) -> float:
    """Return the state at `inference` of a random walk of standard normal steps that starts at 0 at inference 0.

    Like `autoregressive`, a sum of the beginning of one stream.
    """
    return float(np.random.default_rng((seed, Stream.SCALE)).standard_normal(inference).sum())


def rigid(xi: np.ndarray, translation: float, rotation: float) -> np.ndarray:
    """Return the rigid motion (4, 4) of `xi` (v, ω) with v scaled by `translation` and ω by `rotation`."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation * np.asarray(xi[3:], np.float64)).as_matrix()
    T[:3, 3] = translation * np.asarray(xi[:3], np.float64)
    return T


def smooth_field(shape: tuple[int, int], length: float, key: tuple[int, ...], image_share: float) -> np.ndarray:
    """Return a unit-variance Gaussian field (h, w), float32, with correlation exp(-r²/2·length²), r in pixels.

    White noise on a coarse grid, filtered by a Gaussian of length/√2, which is the grid's spacing too.
    """
    rows, columns = (gaussian_weights(n, length / math.sqrt(2)) for n in shape)
    noise = shared_normals((rows.shape[1], columns.shape[1]), key, image_share)
    # einsum and not @: its sums do not depend on the number of BLAS threads, and the bits must not either.
    return np.einsum("hj,wj->hw", np.einsum("hi,ji->hj", rows, np.ascontiguousarray(noise.T)), columns)


def gaussian_weights(size: int, sigma: float) -> np.ndarray:
    """Return weights (size, knots), float32, of knots `sigma` apart; the squares of each row sum to 1."""
    knots = sigma * np.arange(-4, math.ceil((size - 1) / sigma) + 5)
    weights = np.exp(-0.5 * ((np.arange(size)[:, None] - knots) / sigma) ** 2)
    return (weights / np.linalg.norm(weights, axis=1, keepdims=True)).astype(np.float32)


def edge_band(depth: np.ndarray, step: float) -> np.ndarray:
    """Return the valid pixels (h, w) within 2 px of a relative depth difference of more than `step`.

    The step lies between two neighbouring pixels, so two pixels on each side are within 2 px of it.
    """
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
    """The labels as seen from one place in one direction, where each class is another one with probability `share`.

    All pixels of a class err together, and so do all frames of one cell and sector, so more frames from there are no
    more evidence; another view errs independently. A pixel without a class (-1) has none.
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
