"""Cameras as a mesh that every viewer of meshes draws: a pyramid of thin bars for each, and the path between them."""

import os

import numpy as np

from emgs_jax.io.ply import structured, with_colors, write_ply
from emgs_jax.ops.camera import Camera

_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))  # 0 is the apex, 1 to 4 go round the image
_BAR = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)])  # sides of a three-sided bar
_SHARE, _THICKNESS = 0.04, 0.03  # a pyramid's depth of the path's extent, a bar's radius of that depth
_SMALLEST = 0.05  # metres; depth of a pyramid where the camera hardly moves


def save_frustums(
    path: str | os.PathLike,
    camera: Camera,
    T_world_camera: np.ndarray,
    colors: np.ndarray,
    joined: np.ndarray,
    path_color: np.ndarray,
) -> int:
    """Write cameras and path as coloured triangles; returns how many triangles.

    Args:
        path: of the PLY.
        camera: whose pyramids have the images' shape.
        T_world_camera: (n, 4, 4), metres.
        colors: (n, 3), RGB in [0, 1], of each camera.
        joined: (n - 1,), whether the path goes from each camera to the next.
        path_color: (3,).
    """
    centers = T_world_camera[:, :3, 3]
    depth = max(_SHARE * float(np.linalg.norm(np.ptp(centers, axis=0))), _SMALLEST)
    (fx, fy), (cx, cy) = np.float64(camera.focal), np.float64(camera.center)
    x, y = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
    x, y = depth * (x - cx) / fx, depth * (y - cy) / fy
    shape = np.array([(0, 0, 0), (x[0], y[0], depth), (x[1], y[0], depth), (x[1], y[1], depth), (x[0], y[1], depth)])
    corners = np.einsum("nij,kj->nki", T_world_camera[:, :3, :3], shape) + centers[:, None]
    first, last = (corners[:, list(ends)].reshape(-1, 3) for ends in zip(*_EDGES, strict=True))
    first, last = np.concatenate([first, centers[:-1][joined]]), np.concatenate([last, centers[1:][joined]])
    of_path = np.broadcast_to(path_color, (int(joined.sum()), 3))
    of_bars = np.concatenate([np.repeat(colors, len(_EDGES), axis=0), of_path])
    vertices = _bars(first, last, _THICKNESS * depth)
    faces = (6 * np.arange(len(first))[:, None, None] + _BAR).reshape(-1, 3)
    rows = structured(vertices.reshape(-1, 3).astype(np.float32), ["x", "y", "z"])
    write_ply(path, with_colors(rows, np.repeat(of_bars, 6, axis=0)), faces)
    return len(faces)


def _bars(first: np.ndarray, last: np.ndarray, radius: float) -> np.ndarray:
    """Corners (b, 6, 3) of three-sided bars from `first` to `last` (b, 3): three round each end."""
    along = last - first
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0, along / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(along, across)
    turns = 2 * np.pi * np.arange(3) / 3
    ring = radius * (np.cos(turns)[:, None] * across[:, None] + np.sin(turns)[:, None] * up[:, None])
    return np.concatenate([first[:, None] + ring, last[:, None] + ring], axis=1)
