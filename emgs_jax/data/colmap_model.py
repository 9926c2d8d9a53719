"""COLMAP's sparse model as it is read, from text or binary: cameras, and images with their poses.

Its poses are world → camera; ours are camera → world. pycolmap does not read them here: a damaged binary file makes it
hang or ask for gigabytes, it names no line, and it wants all points.
"""

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.data import reading
from emgs_jax.data.camera_models import MODELS, Calibration, as_number, from_colmap, size_of

TEXT, BINARY = ("cameras.txt", "images.txt"), ("cameras.bin", "images.bin")
MAX_NORM_ERROR = 1e-2  # of a quaternion: files of others have few digits
POINT_SIZE = 24  # bytes of a point in images.bin: x, y and the number of its landmark


@dataclass(frozen=True)
class SparseModel:
    """The cameras and images of a model.

    Args:
        cameras: by id.
        names: of the image files, below the folder of images.
        T_world_camera: (n, 4, 4), in the model's unit.
    """

    cameras: dict[int, Calibration]
    names: list[str]
    camera_ids: list[int]
    T_world_camera: np.ndarray
    files: tuple[Path, ...]


def load_colmap(folder: Path) -> SparseModel:
    """Read the cameras and images of a model, from binary files where they are there, as COLMAP does, else from text.

    Raises:
        ValueError: a line or a record is damaged, or there is no image with a pose.
    """
    return (_load_binary if all((folder / name).is_file() for name in BINARY) else _load_text)(folder)


class _Records:
    """A binary file, read from its beginning; what ends before it should is a ValueError that names it."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._place = path, reading.read_bytes(path), 0

    def values(self, layout: str) -> tuple[Any, ...]:
        """The next values; little-endian and without gaps."""
        size = struct.calcsize(f"<{layout}")
        return struct.unpack(f"<{layout}", self.skip(size))

    def text(self) -> str:
        """As far as the next zero byte."""
        return self.skip(self._data.find(b"\0", self._place) + 1 - self._place)[:-1].decode("utf-8", "replace")

    def skip(self, size: int) -> bytes:
        if not 0 <= size <= len(self._data) - self._place:
            raise ValueError(f"{self._path} is damaged: it ends within a record; export the model again")
        self._place += size
        return self._data[self._place - size : self._place]

    def end(self) -> None:
        if self._place < len(self._data):
            raise ValueError(f"{self._path} is damaged: it goes on after its last record; export the model again")


def load_cameras(path: Path) -> dict[int, Calibration]:
    """The cameras of cameras.txt or cameras.bin by id."""
    return (_binary_cameras if path.suffix.lower() == ".bin" else _text_cameras)(path)


def _binary_cameras(path: Path) -> dict[int, Calibration]:
    records, cameras, names = _Records(path), {}, [*MODELS]
    for _ in range(*records.values("Q")):
        key, number, *size = records.values("IiQQ")
        if not 0 <= number < len(names) or key in cameras:
            raise ValueError(f"{path} is damaged: camera {key} is there twice or of no model; export it again")
        params = records.values(f"{len(MODELS[names[number]].split())}d")
        cameras[key] = from_colmap(names[number], params, size_of(*size, path), path)
    records.end()
    return cameras


def _text_cameras(path: Path) -> dict[int, Calibration]:
    cameras: dict[int, Calibration] = {}
    for number, line in _lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or not words[0].isdecimal() or int(words[0]) in cameras:
            raise ValueError(f"{path}:{number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}")
        key, model, width, height, *params = words
        size = size_of(*(as_number(side, "a side", path) for side in (width, height)), path)
        cameras[int(key)] = from_colmap(model, params, size, path)
    return cameras


def _load_binary(folder: Path) -> SparseModel:
    """Read cameras.bin and images.bin, whose layout is in COLMAP's documentation of its output format."""
    cameras_file, images_file = (folder / name for name in BINARY)
    cameras = load_cameras(cameras_file)
    records, images = _Records(images_file), []
    for _ in range(*records.values("Q")):
        number, *values = records.values("I7dI")
        name, place = records.text(), f"{images_file}, image {number}"
        records.skip(POINT_SIZE * records.values("Q")[0])
        images.append((number, name, values[-1], _pose(np.array(values[:-1]), place)))
    records.end()
    images.sort(key=lambda image: image[0])
    names, ids, poses = ([image[column] for image in images] for column in (1, 2, 3))
    return _checked(SparseModel(cameras, names, ids, _inverted(poses), (cameras_file, images_file)), folder)


def check_whole(folder: Path) -> None:
    """Check that the binary files of a model do not end too soon; pycolmap would not end.

    Raises:
        ValueError: one does.
    """
    for path in sorted(folder.glob("*.bin")):
        if path.stem in _SKIP:
            records = _Records(path)
            for _ in range(*records.values("Q")):
                _SKIP[path.stem](records)
            records.end()


def _skip_camera(records: _Records) -> None:
    _, number, _, _ = records.values("IiQQ")
    known = [*MODELS.values()]
    records.skip(8 * len(known[number].split()) if 0 <= number < len(known) else -1)


def _skip_image(records: _Records) -> None:
    records.values("I7dI")
    records.text()
    records.skip(POINT_SIZE * records.values("Q")[0])


def _skip_point(records: _Records) -> None:
    records.skip(43)
    records.skip(8 * records.values("Q")[0])


def _skip_rig(records: _Records) -> None:
    _, count = records.values("II")
    for number in range(count):
        records.values("iI")
        if number and records.values("?")[0]:
            records.values("7d")


def _skip_frame(records: _Records) -> None:
    records.values("II7d")
    records.skip(16 * records.values("I")[0])


_SKIP = {
    "cameras": _skip_camera,
    "images": _skip_image,
    "points3D": _skip_point,
    "rigs": _skip_rig,
    "frames": _skip_frame,
}


def _load_text(folder: Path) -> SparseModel:
    """Read cameras.txt and images.txt."""
    cameras_file, images_file = (folder / name for name in TEXT)
    cameras = load_cameras(cameras_file)
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
        words = points.split()
        if len(words) % 3 or (words and not _is_whole(words[-1])):  # a name of three words is no point
            raise ValueError(
                f"{images_file}:{after}: expected the points of image {name} (X Y POINT3D_ID each) or an empty line, "
                f"got {points[:80]!r}: every image has two lines"
            )
    return _checked(SparseModel(cameras, names, ids, _inverted(poses), (cameras_file, images_file)), folder)


def _is_whole(word: str) -> bool:
    return word.removeprefix("-").isdecimal()


def _lines(path: Path) -> list[tuple[int, str]]:
    return [*enumerate(reading.read_text(path).splitlines(), start=1)]


def _image(line: str, place: str) -> tuple[str, int, np.ndarray]:
    """Name, camera and world → camera (4, 4) of a line of images.txt."""
    words = line.strip().split(maxsplit=9)
    try:
        values = np.array([float(word) for word in words[1:8]])
        camera_id, name = int(words[8]), words[9]
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"{place}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r} ({error}): "
            "export the model again"
        ) from error
    return name, camera_id, _pose(values, place)


def _pose(values: np.ndarray, place: str) -> np.ndarray:
    """World → camera (4, 4) of QW QX QY QZ TX TY TZ."""
    if not np.isfinite(values).all() or abs(math.hypot(*values[:4]) - 1) > MAX_NORM_ERROR:
        raise ValueError(f"{place}: the pose is not finite or its quaternion has not length 1: export the model again")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix(), values[4:]
    return pose


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
