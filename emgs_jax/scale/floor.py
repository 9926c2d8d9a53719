"""The floor of a scene, and how high cameras are above it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LEVEL_DEG = 15.0  # between up and the normal of a floor
BIN = 0.02  # of the median distance of points and cameras: thickness of a level
MIN_SHARE = 0.15  # of the largest level's area: what is lower than the floor is noise
MIN_STD = 0.02  # of the logarithm of a height: the floor's own error


class Surfaces(NamedTuple):
    """Patches of surfaces in the world."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # unit vectors
    areas: Float[np.ndarray, "n"]


def surfaces_of(points: Float[np.ndarray, "h w 3"], T_world_camera: Float[np.ndarray, "4 4"], step: int) -> Surfaces:
    """Return the patches of a frame, every `step` pixels.

    A normal is the cross product of the differences to the pixels `step` to the right and below, where neither is more
    than a twentieth farther or nearer.

    Args:
        points: in the camera's axes, 0 where there is none.
    """
    sampled = points[::step, ::step].astype(np.float64)
    here, right, below = sampled[:-1, :-1], sampled[:-1, 1:], sampled[1:, :-1]
    z = np.stack([part[..., 2] for part in (here, right, below)])
    is_known = (z > 0).all(axis=0) & (np.ptp(z, axis=0) <= 0.05 * z[0])
    here, right, below = here[is_known], right[is_known], below[is_known]
    crossed = np.cross(below - here, right - here)
    length = np.linalg.norm(crossed, axis=1)
    is_one = length > 0
    here, normals, areas = here[is_one], crossed[is_one] / length[is_one, None], length[is_one]
    rotation, center = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return Surfaces(here @ rotation.T + center, normals @ rotation.T, areas)


def floor_level(surfaces: Surfaces, up: Float[np.ndarray, "3"], centers: Float[np.ndarray, "c 3"]) -> float | None:
    """Return the height of the floor along `up`: the lowest large level below the cameras; None without one.

    A level is a bin of heights; its area is that of patches that lie flat. Points below the floor, mirrored or wrong,
    are few.
    """
    heights, cameras = surfaces.points @ up, centers @ up
    is_flat = surfaces.normals @ up >= np.cos(np.radians(LEVEL_DEG))
    is_flat &= heights < np.median(cameras)
    if not is_flat.any():
        return None
    width = BIN * float(np.median(np.median(cameras) - heights[is_flat]))
    edges = np.arange(heights[is_flat].min() - width, np.median(cameras) + 2 * width, width)
    area, _ = np.histogram(heights[is_flat], edges, weights=surfaces.areas[is_flat])
    area = np.convolve(area, np.ones(3), "same")
    is_peak = (area >= np.roll(area, 1)) & (area >= np.roll(area, -1)) & (area >= MIN_SHARE * area.max())
    lowest = edges[np.flatnonzero(is_peak)[0]] + 0.5 * width
    near = is_flat & (np.abs(heights - lowest) <= 2 * width)
    return float(np.average(heights[near], weights=surfaces.areas[near]))
