"""Do poses and depths fit each other? A pose of another convention or unit is found out by the depths of two views."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.ops.axes import FLIP

MAX_MISFIT = 0.02  # of the depth, median; below, poses are right enough whatever else fits
MIN_GAIN, GOOD_MISFIT = 3.0, 0.05  # by which another convention must fit better to be named, and how well at least
MIN_SHARED = 100  # points
STEP = 4  # every fourth pixel of every fourth row
MILLIMETRES = 1000.0


class Sight(NamedTuple):
    """A view: points (h, w, 3) of its camera, where they can be used, and its pose."""

    points: Float[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    T_world_camera: Float[np.ndarray, "4 4"]


def check_conventions(pairs: Iterable[tuple[Sight, Sight]], intrinsics: Sequence[float], source: str) -> None:
    """Raise ValueError where poses of another convention or unit fit the depths much better than those given.

    Args:
        pairs: of views that see the same.
        intrinsics: fx, fy, cx, cy.
        source: file and key of the poses.
    """
    misfits: dict[str, list[float]] = {}
    for a, b in pairs:
        for name, (pose_a, pose_b) in _readings(a.T_world_camera, b.T_world_camera).items():
            misfits.setdefault(name, []).append(misfit(a, b, np.linalg.inv(pose_a) @ pose_b, intrinsics))
    found = {name: float(np.median(values)) for name, values in misfits.items()}
    if not found or not found["as they are"] > MAX_MISFIT:
        return
    best = min(found, key=lambda name: found[name])
    if found[best] < min(found["as they are"] / MIN_GAIN, GOOD_MISFIT):
        raise ValueError(
            f"{source}: the depths of two views differ by {100 * found['as they are']:.1f} % (inf: they share "
            f"nothing), and by {100 * found[best]:.1f} % where the poses are taken as {best}: expected are camera -> "
            "world, axes of OpenCV (x right, y down, z ahead), and one unit for poses and depths"
        )


def misfit(a: Sight, b: Sight, T_a_b: Float[np.ndarray, "4 4"], intrinsics: Sequence[float]) -> float:
    """Median of |log of the ratio| of the depths of b's points in a and those that a has there; inf for too few."""
    fx, fy, cx, cy = intrinsics
    points = b.points[::STEP, ::STEP][b.mask[::STEP, ::STEP]] @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    points = points[points[:, 2] > 0]
    u = np.rint(fx * points[:, 0] / points[:, 2] + cx)
    v = np.rint(fy * points[:, 1] / points[:, 2] + cy)
    height, width = a.mask.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    rows, columns = v[inside].astype(int), u[inside].astype(int)
    known = a.mask[rows, columns]
    if known.sum() < MIN_SHARED:
        return np.inf
    ratios = points[inside, 2][known] / a.points[rows, columns, 2][known]
    return float(np.median(np.abs(np.log(ratios))))


def _readings(a: np.ndarray, b: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Two poses as they are and as other conventions have them."""
    flip, inverse = np.array(FLIP), np.linalg.inv
    found = {
        "as they are": (a, b),
        "world -> camera": (inverse(a), inverse(b)),
        "camera -> world of OpenGL's axes": (a * flip, b * flip),
        "world -> camera of OpenGL's axes": (inverse(a) * flip, inverse(b) * flip),
    }
    for name, factor in (("in millimetres", 1 / MILLIMETRES), ("in metres beside depths in mm", MILLIMETRES)):
        scale = np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])
        found[name] = a * scale, b * scale
    return found
