"""What COLMAP found, as arrays: poses with their covariances, points, which frame shows which, and the lens."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp
from tqdm import tqdm

from emgs_jax.data.masks import stem
from emgs_jax.geometry import scale_covariance
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.uncertainty import camera_in_world, covariances

USUAL = 0.1, 100.0  # median depths with which a model keeps its unit: those of metres
NONE = -1  # world of a frame without a pose


@dataclass(frozen=True)
class World:
    """One model: a frame of reference and a unit of its own.

    Args:
        points: (l, 3).
        camera: pycolmap's, of the images that the structure was made of.
    """

    points: np.ndarray
    camera: Any


@dataclass(frozen=True)
class Structure:
    """Poses of a sequence.

    Args:
        worlds: in the order of their first frames.
        world: (n,) row of the world that holds each frame, or NONE.
        T_world_camera: (n, 4, 4), NaN where there is none.
        covariance: (n, 6, 6) of xi, relative to the frame before it in its world: the true pose is T Exp(xi),
            translation first, in the axes of the camera; NaN where it is not known.
        landmarks: of each frame, the rows of its world's points that it shows.
        is_interpolated: (n,) the pose is a guess between neighbours; it shows no landmarks.
    """

    worlds: Sequence[World]
    world: np.ndarray
    T_world_camera: np.ndarray
    covariance: np.ndarray
    landmarks: Sequence[np.ndarray]
    is_interpolated: np.ndarray

    @property
    def is_placed(self) -> np.ndarray:
        """(n,) frames that a world holds by what they show."""
        return (self.world != NONE) & ~self.is_interpolated

    def shown(self, frame: int) -> np.ndarray:
        """The landmarks (k, 3) that a frame shows, in its world."""
        return self.worlds[self.world[frame]].points[self.landmarks[frame]]

    def depths(self, frame: int) -> np.ndarray:
        """Depths z (k,) of the landmarks that a frame shows."""
        T = self.T_world_camera[frame]
        return (self.shown(frame) - T[:3, 3]) @ T[:3, 2]


def to_structure(models: Sequence[Any], names: Sequence[str], config: StructureConfig) -> Structure:
    """The structure of pycolmap's models; a frame that several hold is of the largest.

    Args:
        models: the largest first.
        names: of the frames in order; those of the models' images may have another suffix.
    """
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
    structure = Structure(worlds, world, T, covariance, landmarks, np.zeros(count, bool))
    own = config.model is not None and _is_usual(structure)
    return interpolated(structure if own else in_unit(structure, config.median_depth), config.max_gap)


def _is_usual(structure: Structure) -> bool:
    """Test whether the unit of a model that is given can stay, and say what becomes of it."""
    depths = [np.median(structure.depths(frame)) for frame in np.flatnonzero(structure.is_placed)]
    median, (low, high) = float(np.median(depths)) if depths else 1.0, USUAL
    if low <= median <= high:
        tqdm.write(f"prior.structure.model: its unit stays (its images look {median:.3g} far, in the median)")
        return True
    tqdm.write(
        f"prior.structure.model: its unit is changed, for its images look {median:.3g} far, in the median, and a map "
        f"wants {low:g} to {high:g}: lengths are those of prior.structure.median_depth"
    )
    return False


def in_unit(structure: Structure, median_depth: float) -> Structure:
    """The structure in a unit in which the depths of each world's landmarks have this median."""
    factors = []
    for number in range(len(structure.worlds)):
        frames = np.flatnonzero(structure.world == number)
        depths = np.concatenate([structure.depths(frame) for frame in frames])
        factors.append(median_depth / np.median(depths) if len(depths) else 1.0)
    return scaled(structure, factors)


def scaled(structure: Structure, factors: Sequence[float]) -> Structure:
    """The structure with the lengths of each world times its factor."""
    T, covariance = structure.T_world_camera.copy(), structure.covariance.copy()
    for number, factor in enumerate(factors):
        frames = np.flatnonzero(structure.world == number)
        T[frames, :3, 3] *= factor
        covariance[frames] = scale_covariance(covariance[frames], factor)
    worlds = [replace(w, points=factor * w.points) for w, factor in zip(structure.worlds, factors, strict=True)]
    return replace(structure, worlds=worlds, T_world_camera=T, covariance=covariance)


def interpolated(structure: Structure, max_gap: int) -> Structure:
    """The structure with poses of frames between two of one world, where these are at most `max_gap` in a row."""
    world, T, guessed = structure.world.copy(), structure.T_world_camera.copy(), structure.is_interpolated.copy()
    placed = np.flatnonzero(structure.world != NONE)
    for before, after in zip(placed[:-1], placed[1:], strict=True):
        inside = np.arange(before + 1, after)
        if not len(inside) or len(inside) > max_gap or structure.world[before] != structure.world[after]:
            continue
        share = (inside - before) / (after - before)
        turns = Slerp([0, 1], Rotation.from_matrix(structure.T_world_camera[[before, after], :3, :3]))
        ends = structure.T_world_camera[[before, after], :3, 3]
        T[inside] = np.eye(4)
        T[inside, :3, :3] = turns(share).as_matrix()
        T[inside, :3, 3] = (1 - share)[:, None] * ends[0] + share[:, None] * ends[1]
        world[inside], guessed[inside] = world[before], True
    return replace(structure, world=world, T_world_camera=T, is_interpolated=guessed)
