"""The floor of a scene, and how high cameras are above it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

LEVEL_DEG = 15.0  # between up and the normal of a floor
BIN = 0.02  # of the median distance of points and cameras: thickness of a level
MIN_SHARE = 0.15  # of the largest level's area: what is lower than the floor is noise
MIN_STD = 0.02  # of the logarithm of a height: the floor's own error
TILT_DEG = 3.0  # standard deviation between up, as it was, and the normal of the floor
MAX_OFF = 3.0  # standard deviations within which a patch is of the floor
MAX_BEND = 0.025  # of the inverse depth of a patch, from the mean of opposite ones
NUM_STEPS = 10  # of choosing the patches of the plane anew


class Surfaces(NamedTuple):
    """Patches of surfaces in the world."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # unit vectors
    areas: Float[np.ndarray, "n"]
    frames: Int[np.ndarray, "n"]  # that show them


class Floor(NamedTuple):
    """A plane below the cameras."""

    normal: Float[np.ndarray, "3"]  # unit vector, up
    heights: Float[np.ndarray, "c"]  # of the cameras above it
    std: float  # of a height that all cameras share, in the same unit


def surfaces_of(
    points: Float[np.ndarray, "h w 3"], T_world_camera: Float[np.ndarray, "4 4"], step: int, frame: int
) -> Surfaces:
    """Return the patches of a frame, every `step` pixels.

    A normal is the cross product of the differences between the pixels `step` to its sides, and above and below it. The
    inverse depth of a plane is linear in the pixel, however slanted: where it departs from the mean of two opposite
    ones by more than `MAX_BEND` of itself there is an edge, and no patch.

    Args:
        points: in the camera's axes, 0 where there is none.
    """
    sampled = points[::step, ::step].astype(np.float64)
    here, middle = sampled[1:-1, 1:-1], slice(1, -1)
    beside = [(sampled[middle, :-2], sampled[middle, 2:]), (sampled[:-2, middle], sampled[2:, middle])]
    z, is_known = here[..., 2], here[..., 2] > 0
    for one, other in ((first[..., 2], last[..., 2]) for first, last in beside):
        with np.errstate(divide="ignore", invalid="ignore"):
            bend = np.abs(z * (0.5 / one + 0.5 / other) - 1.0)
        is_known &= (one > 0) & (other > 0) & (bend <= MAX_BEND)
    across, down = (last[is_known] - first[is_known] for first, last in beside)
    crossed, here = np.cross(down, across), here[is_known]
    length = np.linalg.norm(crossed, axis=1)
    is_one = length > 0
    here, normals, areas = here[is_one], crossed[is_one] / length[is_one, None], 0.25 * length[is_one]
    rotation, center = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return Surfaces(here @ rotation.T + center, normals @ rotation.T, areas, np.full(len(areas), frame))


def floor_of(surfaces: Surfaces, up: Float[np.ndarray, "3"], centers: Float[np.ndarray, "c 3"]) -> Floor | None:
    """Fit a plane to the lowest large level below the cameras; None without one.

    A floor is often seen only far from the cameras, where a degree of error in `up` changes its height by 2 % of the
    distance. So heights are above its plane h = c + t·x, where x is horizontal, from the cameras' middle. Each frame
    errs in all its patches alike, by their standard deviation about the plane; the slopes t are 0 ± `TILT_DEG`.
    """
    level = _level(surfaces, up, centers)
    if level is None:
        return None
    height, width = level
    across = np.linalg.svd(up[None])[2][1:]
    middle = np.median(centers @ across.T, axis=0)
    is_flat, (points, _, areas, frames) = _is_flat(surfaces, up), surfaces
    inputs, heights = np.column_stack([np.ones(len(points)), points @ across.T - middle]), points @ up
    prior = np.diag([0.0, 1.0, 1.0]) / np.tan(np.radians(TILT_DEG)) ** 2
    plane, limit = np.array([height, 0.0, 0.0]), 2 * width
    for _ in range(NUM_STEPS):
        off = heights - inputs @ plane
        near = is_flat & (np.abs(off) <= limit)
        if not near.any():
            return None
        std = max(1.4826 * float(np.median(np.abs(off[near]))), 1e-3 * width)
        of_frames = np.bincount(frames[near], areas[near])
        weights = areas[near] * of_frames.sum() / np.sum(of_frames**2) / std**2  # Σ = number of frames / std²
        information = (inputs[near] * weights[:, None]).T @ inputs[near] + prior
        plane = np.linalg.solve(information, (inputs[near] * weights[:, None]).T @ heights[near])
        limit = min(2 * width, MAX_OFF * std)
    normal = up - plane[1:] @ across
    length = np.linalg.norm(normal)
    above = centers @ up - plane[0] - (centers @ across.T - middle) @ plane[1:]
    return Floor(normal / length, above / length, float(np.sqrt(np.linalg.inv(information)[0, 0])))


def _is_flat(surfaces: Surfaces, up: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "n"]:
    return surfaces.normals @ up >= np.cos(np.radians(LEVEL_DEG))


def _level(
    surfaces: Surfaces, up: Float[np.ndarray, "3"], centers: Float[np.ndarray, "c 3"]
) -> tuple[float, float] | None:
    """Return the height along `up` of the lowest large level below the cameras, and the width of a level.

    A level is a bin of heights; its area is that of patches that lie flat. Points below the floor, mirrored or wrong,
    are few.
    """
    heights, cameras = surfaces.points @ up, centers @ up
    is_flat = _is_flat(surfaces, up) & (heights < np.median(cameras))
    if not is_flat.any():
        return None
    width = BIN * float(np.median(np.median(cameras) - heights[is_flat]))
    edges = np.arange(heights[is_flat].min() - width, np.median(cameras) + 2 * width, width)
    area, _ = np.histogram(heights[is_flat], edges, weights=surfaces.areas[is_flat])
    area = np.convolve(area, np.ones(3), "same")
    is_peak = (area >= np.roll(area, 1)) & (area >= np.roll(area, -1)) & (area >= MIN_SHARE * area.max())
    lowest = edges[np.flatnonzero(is_peak)[0]] + 0.5 * width
    near = is_flat & (np.abs(heights - lowest) <= 2 * width)
    return float(np.average(heights[near], weights=surfaces.areas[near])), width
