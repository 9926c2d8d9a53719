"""The known scene that the tests write to disk: a slanted plane, seen from a camera that moves."""

from pathlib import Path

import cv2
import numpy as np


def scene_pose(index: int) -> np.ndarray:
    """T_world_camera of frame `index`: a step aside and a turn about y."""
    angle = 0.05 * index
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.04 * index, 0.01 * index, 0.02 * index]
    return pose


def plane_depth(pose: np.ndarray, intrinsics: tuple[float, ...], size: tuple[int, int]) -> np.ndarray:
    """Camera z in metres (h, w) of the world's plane .3 x - .2 y + z = 2, in closed form."""
    normal, (fx, fy, cx, cy) = np.array([0.3, -0.2, 1.0]), intrinsics
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1) @ pose[:3, :3].T
    return (2.0 - normal @ pose[:3, 3]) / (rays @ normal)


def write_depth(path: Path, depth: np.ndarray, scale: float) -> None:
    """A 16-bit image of so many units a metre."""
    cv2.imwrite(str(path), np.rint(depth * scale).astype(np.uint16))


def color_image(index: int, size: tuple[int, int]) -> np.ndarray:
    """A smooth BGR image that names its frame by its mean."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([u * 120 // size[0], v * 120 // size[1], np.full(u.shape, 40 * index + 20)], -1).astype(np.uint8)


def moved(dataset, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (row, column) of frame i that have depth, and where frame j shows them: column, row and z."""
    a, (fx, fy, cx, cy) = dataset[i], dataset.intrinsics
    v, u = np.nonzero(a.depth > 0)
    z = a.depth[v, u].astype(np.float64)
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, np.ones_like(z)])
    x, y, z = (np.linalg.inv(dataset[j].T_world_camera) @ a.T_world_camera @ points)[:3]
    return np.stack([v, u]), np.stack([fx * x / z + cx, fy * y / z + cy, z])
