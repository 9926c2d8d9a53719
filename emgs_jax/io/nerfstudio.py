"""nerfstudio's transforms.json: camera → world with OpenGL's axes, pixels counted from the image's corner."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.io.files import write_json
from emgs_jax.ops.camera import Camera

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes (y down, z ahead) from OpenGL's (y up, z back), and back


def save_transforms(path: Path, camera: Camera, names: Sequence[str], T_world_camera: Any, points_file: str) -> None:
    """Write transforms.json of one pinhole camera.

    Args:
        path: of the file.
        camera: of all images.
        names: of the image files, from the folder of `path`.
        T_world_camera: (n, 4, 4), OpenCV axes, metres.
        points_file: a PLY in the same world, from the folder of `path`.
    """
    (fx, fy), (cx, cy) = np.float64(camera.focal), np.float64(camera.center)
    known = {"camera_model": "PINHOLE", "w": camera.width, "h": camera.height}
    known |= {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "ply_file_path": points_file}
    poses = np.asarray(T_world_camera, np.float64) @ FLIP
    frames = [{"file_path": name, "transform_matrix": pose} for name, pose in zip(names, poses, strict=True)]
    write_json(path, known | {"frames": frames})


def load_transforms(path: Path) -> tuple[list[str], list[list[float]]]:
    """File and camera → world with OpenCV's axes, 16 numbers row by row, of every frame of a transforms.json.

    Raises:
        ValueError: the file is no such file, or has no frames; the message names what is wrong with it.
    """
    try:
        frames = json.loads(path.read_text(encoding="utf-8-sig", errors="replace"))["frames"]
        names = [frame["file_path"] for frame in frames]
        matrices = [np.array(frame["transform_matrix"], np.float64) for frame in frames]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"{path} must hold frames with file_path and transform_matrix, and it does not ({error!r}): export it again"
        ) from error
    if not names:
        raise ValueError(f"{path} has no frames: export it again")
    for name, matrix in zip(names, matrices, strict=True):
        if not isinstance(name, str) or matrix.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"{path}: frame {name!r} must have a transform_matrix of 4 rows of 4: export it again")
    bottom = [[0.0, 0.0, 0.0, 1.0]]
    return names, [((m if len(m) == 4 else np.vstack([m, bottom])) @ FLIP).ravel().tolist() for m in matrices]
