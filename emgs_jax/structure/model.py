"""COLMAP's result as arrays: poses with covariances, points, their visibility, and the lens."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from emgs_jax.data.masks import stem
from emgs_jax.geometry import scale_covariance
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.uncertainty import camera_in_world, covariances

USUAL = 0.1, 100.0  # median depths with which a model keeps its unit: those of metres
NONE = -1  # world of a frame without a pose


@dataclass(frozen=True)
class World:
    """One model, with its own frame of reference and unit."""

    points: np.ndarray  # (l, 3)
    camera: Any  # pycolmap's, of the structure's images


@dataclass(frozen=True)
class Structure:
    """Poses of a sequence."""

    worlds: Sequence[World]  # in the order of their first frames
    world: np.ndarray  # (n,) row of each frame's world, or NONE
    T_world_camera: np.ndarray  # (n, 4, 4), NaN without a pose
    # (n, 6, 6) of xi relative to the frame before in its world, where the true pose is T Exp(xi), translation first, in
    # the camera's axes; NaN where unknown.
    covariance: np.ndarray
    landmarks: Sequence[np.ndarray]  # rows of the world's points that each frame shows
    num_adjusted: int = 0  # frames at the last adjustment of all

    @property
    def is_placed(self) -> np.ndarray:
        """(n,) frames with a pose from landmarks."""
        return self.world != NONE

    def shown(self, frame: int) -> np.ndarray:
        """The landmarks (k, 3) of a frame, in its world."""
        return self.worlds[self.world[frame]].points[self.landmarks[frame]]

    def depths(self, frame: int) -> np.ndarray:
        """Depths z (k,) of a frame's landmarks."""
        T = self.T_world_camera[frame]
        return (self.shown(frame) - T[:3, 3]) @ T[:3, 2]


def to_structure(models: Sequence[Any], names: Sequence[str], config: StructureConfig) -> Structure:
    """Convert pycolmap's models, the largest first, which gets a frame that several hold; `names` are the frames'."""
    row = {name: index for index, name in enumerate(names)}
    taken: set[int] = set()
    found = []
    for model in models:
        images = {
            row[stem(image.name)]: image
            for image in model.images.values()
            if image.has_pose and stem(image.name) in row
        }
        images = {frame: image for frame, image in sorted(images.items()) if frame not in taken}
        taken |= images.keys()
        if images:
            found.append((model, images))
    found.sort(key=lambda pair: min(pair[1]))
    count = len(names)
    world, T, covariance = np.full(count, NONE), np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    landmarks, worlds = [np.zeros(0, int)] * count, []
    for number, (model, images) in enumerate(found):
        ids = sorted(model.points3D)
        place = {key: index for index, key in enumerate(ids)}
        points = np.array([model.points3D[key].xyz for key in ids]).reshape(-1, 3)
        worlds.append(World(points, copy.copy(next(iter(images.values())).camera)))
        spread = covariances(model, images, config.pixel_std)
        for frame, image in images.items():
            world[frame], T[frame] = number, camera_in_world(image)
            covariance[frame] = spread.get(frame, np.nan)
            shown = {place[point.point3D_id] for point in image.points2D if point.has_point3D()}
            landmarks[frame] = np.array(sorted(shown), int)
    structure = Structure(worlds, world, T, covariance, landmarks)
    own = config.model is not None and _is_usual(structure)
    return structure if own else in_unit(structure, config.median_depth)


def median_depth(structure: Structure) -> float:
    """How far the landmarks of an image are in the median, over all images; 1 without any."""
    shown = (structure.depths(frame) for frame in np.flatnonzero(structure.is_placed))
    depths = [np.median(depths) for depths in shown if len(depths)]
    return float(np.median(depths)) if depths else 1.0


def _is_usual(structure: Structure) -> bool:
    """Test whether the unit of a model that is given can stay, and say what becomes of it."""
    median, (low, high) = median_depth(structure), USUAL
    if low <= median <= high:
        tqdm.write(f"prior.structure.model: its unit stays (its images look {median:.3g} far, in the median)")
        return True
    tqdm.write(
        f"prior.structure.model: its unit is changed, for its images look {median:.3g} far, in the median, and a map "
        f"wants {low:g} to {high:g}: lengths are those of prior.structure.median_depth"
    )
    return False


def in_unit(structure: Structure, median_depth: float) -> Structure:
    """Scale each world so that its landmarks' depths have this median."""
    factors = []
    for number in range(len(structure.worlds)):
        frames = np.flatnonzero(structure.world == number)
        depths = np.concatenate([structure.depths(frame) for frame in frames])
        factors.append(median_depth / np.median(depths) if len(depths) else 1.0)
    return scaled(structure, factors)


def without_worlds(structure: Structure, numbers: Sequence[int]) -> Structure:
    """Take the poses from the frames of some worlds, whose numbers stay."""
    is_out = np.isin(structure.world, numbers)
    T = np.where(is_out[:, None, None], np.nan, structure.T_world_camera)
    return replace(structure, world=np.where(is_out, NONE, structure.world), T_world_camera=T)


def scaled(structure: Structure, factors: Sequence[float]) -> Structure:
    """Multiply the lengths of each world by its factor."""
    T, covariance = structure.T_world_camera.copy(), structure.covariance.copy()
    for number, factor in enumerate(factors):
        frames = np.flatnonzero(structure.world == number)
        T[frames, :3, 3] *= factor
        covariance[frames] = scale_covariance(covariance[frames], factor)
    worlds = [replace(w, points=factor * w.points) for w, factor in zip(structure.worlds, factors, strict=True)]
    return replace(structure, worlds=worlds, T_world_camera=T, covariance=covariance)
