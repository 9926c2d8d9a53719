"""Landmarks of a structure as seen by a frame: pixel, depth and standard deviation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from emgs_jax.ops.camera import Camera
from emgs_jax.structure.model import Structure


class Landmarks(NamedTuple):
    """Landmarks in a frame."""

    pixels: np.ndarray  # (k, 2) column and row
    depth: np.ndarray  # (k,) z in the unit of the structure
    std: np.ndarray  # (k,) of log z
    weight: np.ndarray  # (k,) 1 / number of landmarks in the same cell of the image, where a network errs alike


def point_information(structure: Structure, world: int, pixel_std: float) -> Float[np.ndarray, "l 3 3"]:
    """Information matrix of each point of a world with fixed poses, Σ f² / (d² σ²) (I - u uᵀ) over the frames.

    f is the focal length, d the distance and u the direction from the camera, σ = `pixel_std` that of a keypoint in
    pixels of the structure's images.
    """
    points = structure.worlds[world].points
    found, focal = np.zeros((len(points), 3, 3)), structure.worlds[world].camera.mean_focal_length()
    for frame in np.flatnonzero((structure.world == world) & structure.is_placed):
        rows = structure.landmarks[frame]
        ray = points[rows] - structure.T_world_camera[frame, :3, 3]
        squared = np.sum(ray**2, axis=1)[:, None, None]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :] / squared
        found[rows] += across * (focal / pixel_std) ** 2 / squared
    return found


def landmarks_of(
    structure: Structure, frame: int, information: Float[np.ndarray, "l 3 3"], camera: Camera, cell: float
) -> Landmarks:
    """The landmarks of a frame that lie before it, within the image; `cell` is a share of the image's longer side."""
    points, T = structure.shown(frame), structure.T_world_camera[frame]
    ray = points - T[:3, 3]
    local = ray @ T[:3, :3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.float64(camera.focal) * local[:, :2] / depth[:, None] + np.float64(camera.center)
    size = np.array([camera.width, camera.height])
    is_shown = (depth > 0) & ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
    pixels, depth, ray = pixels[is_shown], depth[is_shown], ray[is_shown]
    known = np.einsum("ki,kij,kj->k", ray, information[structure.landmarks[frame][is_shown]], ray)
    cells = (pixels // (cell * size.max())).astype(int)
    _, place, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return Landmarks(pixels, depth, 1.0 / np.sqrt(np.maximum(known, 1e-12)), 1.0 / counts[place.reshape(-1)])
