"""COLMAP's sparse model as it is written: cameras, images with their poses, and points, as text.

COLMAP counts pixels from the image's corner and its poses are world → camera; ours are camera → world, with pixel
centres at integers. `data.colmap_model` reads it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.io.files import write_file
from emgs_jax.ops.camera import Camera


def save_colmap(
    folder: Path, camera: Camera, names: Sequence[str], T_world_camera: Any, points: Any, colors: Any
) -> None:
    """Write cameras.txt, images.txt and points3D.txt of one pinhole camera.

    Args:
        folder: that is there.
        camera: of all images.
        names: of the image files.
        T_world_camera: (n, 4, 4), metres.
        points: (p, 3), metres, world; written without tracks.
        colors: (p, 3), RGB, uint8.
    """
    poses = np.linalg.inv(np.asarray(T_world_camera, np.float64))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    (fx, fy), (cx, cy) = np.float64(camera.focal), np.float64(camera.center)
    numbers = _words((fx, fy, cx + 0.5, cy + 0.5))
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", f"1 PINHOLE {camera.width} {camera.height} {numbers}"]
    _write(folder / "cameras.txt", lines)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] (none)"]
    for number, (name, turn, pose) in enumerate(zip(names, turns, poses, strict=True), start=1):
        lines += [f"{number} {_words((*turn, *pose[:3, 3]))} 1 {name}", ""]
    _write(folder / "images.txt", lines)
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] (no error is known: -1)"]
    for number, (point, color) in enumerate(zip(np.float64(points), np.asarray(colors), strict=True), start=1):
        lines.append(f"{number} {point[0]:.9g} {point[1]:.9g} {point[2]:.9g} {color[0]} {color[1]} {color[2]} -1")
    _write(folder / "points3D.txt", lines)


def _words(values: Sequence[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _write(path: Path, lines: list[str]) -> None:
    write_file(path, "\n".join(lines) + "\n")
