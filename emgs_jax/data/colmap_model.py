"""COLMAP's sparse model as it is read, from text or binary: cameras, and images with their poses.

COLMAP counts pixels from the image's corner and its poses are world → camera; ours are camera → world, with pixel
centres at integers.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
