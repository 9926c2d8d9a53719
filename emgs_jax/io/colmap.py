"""COLMAP's sparse model: cameras, images with their poses, points. Text is written; text and binary are read.

COLMAP counts pixels from the image's corner and its poses are world → camera; ours are camera → world, with pixel
centres at integers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.io.files import atomic_write
from emgs_jax.ops.camera import Camera

TEXT, BINARY = ("cameras.txt", "images.txt"), ("cameras.bin", "images.bin")
MAX_NORM_ERROR = 1e-2  # of a quaternion: files of others have few digits


@dataclass(frozen=True)
class SparseModel:
    """The cameras and images of a model.

    Args:
        cameras: by id the words MODEL WIDTH HEIGHT PARAMS… as in cameras.txt, in COLMAP's own pixels.
        names: of the image files, below the folder of images.
        camera_ids: of each image.
        T_world_camera: (n, 4, 4), in the model's unit.
        files: that were read.
    """

    cameras: dict[int, list[str]]
    names: list[str]
    camera_ids: list[int]
    T_world_camera: np.ndarray
    files: tuple[Path, ...]


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
    with atomic_write(path, "w") as handle:
        handle.write("\n".join(lines) + "\n")


def load_colmap(folder: Path) -> SparseModel:
    """Read the cameras and images of a model, from text, or from binary files with pycolmap.

    Raises:
        ValueError: a line is damaged, there is no image, or the files are binary and pycolmap is not installed.
    """
    if all((folder / name).is_file() for name in TEXT):
        return _load_text(folder)
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(
            f'{folder} holds binary files: pip install "emgs_jax[colmap]", which reads them, or write text with '
            "colmap model_converter --output_type TXT"
        ) from error
    try:
        model = pycolmap.Reconstruction(str(folder))
        cameras = {
            int(key): [found.model.name, str(found.width), str(found.height), *(f"{v:.17g}" for v in found.params)]
            for key, found in model.cameras.items()
        }
        images = [image for _, image in sorted(model.images.items()) if image.has_pose]
        poses = [np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images]
    except (RuntimeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise ValueError(f"{folder} is no model that pycolmap can read: {str(error).splitlines()[0][:200]}") from error
    names, ids = [image.name for image in images], [int(image.camera_id) for image in images]
    return _checked(SparseModel(cameras, names, ids, _inverted(poses), tuple(folder / name for name in BINARY)), folder)


def _load_text(folder: Path) -> SparseModel:
    """Read cameras.txt and images.txt."""
    cameras_file, images_file = (folder / name for name in TEXT)
    cameras: dict[int, list[str]] = {}
    for number, line in _lines(cameras_file):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or not words[0].isdecimal() or int(words[0]) in cameras:
            raise ValueError(
                f"{cameras_file}:{number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}"
            )
        cameras[int(words[0])] = words[1:]
    names, ids, poses = [], [], []
    lines = iter(_lines(images_file))
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        name, camera_id, pose = _image(line, f"{images_file}:{number}")
        names.append(name)
        ids.append(camera_id)
        poses.append(pose)
        after, points = next(lines, (number + 1, ""))
        if len(points.split()) % 3:
            raise ValueError(
                f"{images_file}:{after}: expected the points of image {name} (X Y POINT3D_ID each) or an empty line, "
                f"got {points[:80]!r}: every image has two lines"
            )
    return _checked(SparseModel(cameras, names, ids, _inverted(poses), (cameras_file, images_file)), folder)


def _lines(path: Path) -> list[tuple[int, str]]:
    return [*enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1)]


def _image(line: str, place: str) -> tuple[str, int, np.ndarray]:
    """Name, camera and world → camera (4, 4) of a line of images.txt."""
    words = line.strip().split(maxsplit=9)
    try:
        values = np.array([float(word) for word in words[1:8]])
        camera_id, name = int(words[8]), words[9]
        if not np.isfinite(values).all() or abs(math.hypot(*values[:4]) - 1) > MAX_NORM_ERROR:
            raise ValueError("the quaternion has not length 1")
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"{place}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r} ({error}): "
            "export the model again"
        ) from error
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix(), values[4:]
    return name, camera_id, pose


def _inverted(poses: list[np.ndarray]) -> np.ndarray:
    return np.linalg.inv(np.array(poses, np.float64).reshape(-1, 4, 4))


def _checked(model: SparseModel, folder: Path) -> SparseModel:
    """The model, whose images all name a camera of it and are named once."""
    if not model.names:
        raise ValueError(f"{folder} has no images with a pose: register some, or give another model")
    if missing := sorted({*model.camera_ids} - model.cameras.keys()):
        raise ValueError(f"{folder}: images are of camera {missing[0]}, which has no line: export the model again")
    if len({*model.names}) < len(model.names):
        twice = next(name for name in model.names if model.names.count(name) > 1)
        raise ValueError(f"{folder} has {twice} twice: export the model again")
    return model
