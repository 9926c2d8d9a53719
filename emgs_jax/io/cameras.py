"""Write cameras for other programs: COLMAP's sparse model, nerfstudio's transforms.json, a mesh of frustums.

Both programs count pixels from the image's corner; our pixel centres are integers. COLMAP's poses are world → camera,
nerfstudio's are camera → world with OpenGL's axes.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.io.files import write_file, write_json
from emgs_jax.io.ply import structured, with_colors, write_ply
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.constants import FLIP

_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))  # 0 is the apex, 1 to 4 go round the image
_BAR = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)])  # sides of a three-sided bar
_SHARE, _THICKNESS = 0.04, 0.03  # a pyramid's depth of the path's extent, a bar's radius of that depth
_SMALLEST = 0.05  # metres; depth of a pyramid where the camera hardly moves


def save_colmap(
    folder: Path, camera: Camera, names: Sequence[str], T_world_camera: Any, points: Any, colors: Any
) -> None:
    """Write cameras.txt, images.txt and points3D.txt: one pinhole camera, poses (n, 4, 4), points (p, 3), uint8 RGB."""
    poses = np.linalg.inv(np.asarray(T_world_camera, np.float64))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    (fx, fy), (cx, cy) = np.float64(camera.focal), np.float64(camera.center)
    numbers = _words((fx, fy, cx + 0.5, cy + 0.5))
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", f"1 PINHOLE {camera.width} {camera.height} {numbers}"]
    write_file(folder / "cameras.txt", "\n".join([*lines, ""]))
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] (none)"]
    for number, (name, turn, pose) in enumerate(zip(names, turns, poses, strict=True), start=1):
        lines += [f"{number} {_words((*turn, *pose[:3, 3]))} 1 {name}", ""]
    write_file(folder / "images.txt", "\n".join([*lines, ""]))
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] (no error is known: -1)"]
    for number, (point, color) in enumerate(zip(np.float64(points), np.asarray(colors), strict=True), start=1):
        lines.append(f"{number} {point[0]:.9g} {point[1]:.9g} {point[2]:.9g} {color[0]} {color[1]} {color[2]} -1")
    write_file(folder / "points3D.txt", "\n".join([*lines, ""]))


def _words(values: Sequence[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def save_transforms(
    path: Path, camera: Camera, names: Sequence[str], T_world_camera: Any, points_file: str, masks: Sequence[str] = ()
) -> None:
    """Write transforms.json: one pinhole camera and poses (n, 4, 4) with OpenCV's axes.

    Names of images, of the PLY `points_file` and of masks (one an image, black where unused) are relative to `path`.
    """
    (fx, fy), (cx, cy) = np.float64(camera.focal), np.float64(camera.center)
    known = {"camera_model": "PINHOLE", "w": camera.width, "h": camera.height}
    known |= {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "ply_file_path": points_file}
    poses = np.asarray(T_world_camera, np.float64) * FLIP
    frames = [{"file_path": name, "transform_matrix": pose} for name, pose in zip(names, poses, strict=True)]
    for frame, mask in zip(frames, masks, strict=False):
        frame["mask_path"] = mask
    write_json(path, known | {"frames": frames})


def save_frustums(
    path: str | os.PathLike,
    camera: Camera,
    T_world_camera: np.ndarray,
    colors: np.ndarray,
    joined: np.ndarray,
    path_color: np.ndarray,
) -> int:
    """Write frustums and path as coloured triangles; return the number of triangles.

    Args:
        T_world_camera: (n, 4, 4).
        colors: (n, 3), RGB in [0, 1] of each camera; `path_color` (3,) likewise.
        joined: (n - 1,), True where the path connects a camera to the next.
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
    """Corners (b, 6, 3) of three-sided bars from `first` to `last` (b, 3): three around each end."""
    along = last - first
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0, along / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(along, across)
    turns = 2 * np.pi * np.arange(3) / 3
    ring = radius * (np.cos(turns)[:, None] * across[:, None] + np.sin(turns)[:, None] * up[:, None])
    return np.concatenate([first[:, None] + ring, last[:, None] + ring], axis=1)
