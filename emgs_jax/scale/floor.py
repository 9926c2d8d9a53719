"""The floor of a scene, and how high cameras are above it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

LEVEL_DEG = 15.0  # between up and the normal of a floor
BIN = 0.05  # of the median height of cameras above flat patches: thickness of a level
MIN_SHARE = 0.15  # of the largest level's area: what is lower than the floor is noise
MAX_STEP = 0.25  # of the cameras' height above that level: what else may be the floor, where it or the cameras rise
MIN_STD = 0.02  # of the logarithm of a height: the floor's own error
TILT_DEG = 3.0  # standard deviation between up, as it was, and the normal of the floor
MAX_OFF = 3.0  # standard deviations within which a patch is of the floor
MAX_BEND = 0.025  # of the inverse depth of a patch, from the mean of opposite ones
NUM_STEPS = 10  # of choosing the patches of a plane anew


class Surfaces(NamedTuple):
    """Patches of surfaces in the world."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # unit vectors
    areas: Float[np.ndarray, "n"]
    frames: Int[np.ndarray, "n"]  # that show them


class Floor(NamedTuple):
    """What lies below the cameras."""

    normal: Float[np.ndarray, "3"]  # unit vector, up, the mean below the cameras
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


def certainties(surfaces: Surfaces, centers: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "n"]:
    """Return 1 / σ² of the normals, up to a factor: depths err by a share of themselves, over the width of a patch.

    By areas alone the farthest patches, of trees and banks, would count most, and are the least certain.

    Args:
        centers: of the cameras, by the numbers of the frames.
    """
    return surfaces.areas / np.sum((surfaces.points - centers[surfaces.frames]) ** 2, axis=1)


def floor_of(
    surfaces: Surfaces,
    up: Float[np.ndarray, "3"],
    centers: Float[np.ndarray, "c 3"],
    path: Float[np.ndarray, "p 3"] | None = None,
) -> Floor | None:
    """Fit a plane to the lowest large level below each camera; None without one.

    Ground rises and falls along a road, so each camera has a plane of its own, for which a patch at a horizontal
    distance d counts 1 / (1 + (d/h)²)², where h is the height of the cameras above the level. A floor is often seen
    only far from the cameras, where a degree of error in `up` changes its height by 2 % of the distance. So the plane
    is h = c + t·x, where x is horizontal, from the camera. Each frame errs in all its patches alike, by their standard
    deviation about the plane; the slopes t are 0 ± `TILT_DEG`.

    Args:
        centers: of the cameras that show the surfaces.
        path: centers of all cameras of the walk; None: these.
    """
    is_flat = surfaces.normals @ up >= np.cos(np.radians(LEVEL_DEG))
    flat = Surfaces(*(part[is_flat] for part in surfaces))
    across = np.linalg.svd(up[None])[2][1:]
    level = _level(flat, up, across, centers if path is None else path)
    if level is None:
        return None
    height, is_near = level
    points, _, areas, frames = (part[is_near] for part in flat)
    planes = []
    for center in centers:
        x = (points - center) @ across.T
        inputs = np.column_stack([np.ones(len(x)), x])
        counts = areas * _nearness(np.linalg.norm(x, axis=1), height)
        plane, std = _plane(inputs, (points - center) @ up, counts, frames, 1e-3 * height)
        normal = up - plane[1:] @ across
        planes.append((normal, -plane[0] / np.linalg.norm(normal), std))
    normals, heights, stds = (np.array(part) for part in zip(*planes, strict=True))
    normal = normals.mean(axis=0)
    return Floor(normal / np.linalg.norm(normal), heights, float(np.median(stds)))


def _plane(
    inputs: Float[np.ndarray, "n 3"],
    heights: Float[np.ndarray, "n"],
    counts: Float[np.ndarray, "n"],
    frames: Int[np.ndarray, "n"],
    min_std: float,
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return c and t of h = c + t·x, without patches that lie off it, and the standard deviation of c."""
    prior = np.diag([0.0, 1.0, 1.0]) / np.tan(np.radians(TILT_DEG)) ** 2
    plane = np.array([_median(heights, counts), 0.0, 0.0])
    for _ in range(NUM_STEPS):
        off = np.abs(heights - inputs @ plane)
        std = max(1.4826 * _median(off, counts), min_std)
        near = off <= MAX_OFF * std
        of_frames = np.bincount(frames[near], counts[near])
        weights = counts[near] * of_frames.sum() / np.sum(of_frames**2) / std**2  # Σ = number of frames / std²
        information = (inputs[near] * weights[:, None]).T @ inputs[near] + prior
        plane = np.linalg.solve(information, (inputs[near] * weights[:, None]).T @ heights[near])
    return plane, float(np.sqrt(np.linalg.inv(information)[0, 0]))


def _median(values: Float[np.ndarray, "n"], counts: Float[np.ndarray, "n"]) -> float:
    order = np.argsort(values)
    below = np.cumsum(counts[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def _nearness(distance: Float[np.ndarray, "n"], height: float | Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return 1 / (1 + (distance / height) ** 2) ** 2


def _level(
    flat: Surfaces, up: Float[np.ndarray, "3"], across: Float[np.ndarray, "2 3"], path: Float[np.ndarray, "p 3"]
) -> tuple[float, Bool[np.ndarray, "n"]] | None:
    """Return the cameras' height above the lowest large level below them, and the patches that lie about as low.

    A patch lies below the camera next to it. A level is a bin of these heights. Points below the floor, mirrored or
    wrong, are few.
    """
    distance, camera = cKDTree(path @ across.T).query(flat.points @ across.T)
    below = (path[camera] - flat.points) @ up
    if not (below > 0).any():
        return None
    heights, distance, areas = (part[below > 0] for part in (below, distance, flat.areas))
    width = BIN * float(np.median(heights))
    edges = np.arange(0.0, heights.max() + 3 * width, width)
    area, _ = np.histogram(heights, edges, weights=areas * _nearness(distance, heights))
    area = np.convolve(area, np.ones(3), "same")
    is_peak = (area >= np.roll(area, 1)) & (area >= np.roll(area, -1)) & (area >= MIN_SHARE * area.max())
    height = float(edges[np.flatnonzero(is_peak)[-1]] + 0.5 * width)
    return height, np.abs(below - height) <= MAX_STEP * height
