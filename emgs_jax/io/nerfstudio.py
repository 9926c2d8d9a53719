"""nerfstudio's transforms.json as it is written: camera → world with OpenGL's axes, pixels from the image's corner."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.io.files import write_json
from emgs_jax.ops.axes import FLIP
from emgs_jax.ops.camera import Camera


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
    poses = np.asarray(T_world_camera, np.float64) * FLIP
    frames = [{"file_path": name, "transform_matrix": pose} for name, pose in zip(names, poses, strict=True)]
    write_json(path, known | {"frames": frames})
