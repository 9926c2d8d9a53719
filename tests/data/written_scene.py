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
