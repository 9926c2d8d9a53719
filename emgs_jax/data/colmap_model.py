"""Read COLMAP's sparse model, text or binary: cameras, and images with their poses.

Its poses are world → camera; ours are camera → world. pycolmap is not used: damaged binary files make it hang or
allocate gigabytes, it names no line, and needs all points.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from emgs_jax.data import reading
from emgs_jax.data.camera_models import MODELS, Calibration, as_number, from_colmap, size_of

TEXT, BINARY = ("cameras.txt", "images.txt"), ("cameras.bin", "images.bin")
POINT_SIZE = 24  # bytes of a point in images.bin: x, y and the number of its landmark
Image = tuple[str, int, np.ndarray]  # name, camera and world → camera (4, 4)


@dataclass(frozen=True)
class SparseModel:
    """The cameras and images of a model."""

    cameras: dict[int, Calibration]  # by id
    names: list[str]  # of the image files, below the folder of images
    camera_ids: list[int]
    T_world_camera: np.ndarray  # (n, 4, 4), in the model's unit
    files: tuple[Path, ...]


class _Records:
    """A binary file, read from its beginning; ValueError, which names it, if it ends too soon."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._place = path, reading.read_bytes(path), 0

    def __iter__(self) -> Iterator[Self]:
        """Yield itself for each announced record; then the file must end."""
        for _ in range(*self.values("Q")):
            yield self
        if self._place < len(self._data):
            raise ValueError(f"{self._path} is damaged: it goes on after its last record; export the model again")

    def values(self, layout: str) -> tuple[Any, ...]:
        """The next values; little-endian and without gaps."""
        size = struct.calcsize(f"<{layout}")
        return struct.unpack(f"<{layout}", self.skip(size))

    def text(self) -> str:
        """The text up to the next zero byte."""
        return self.skip(self._data.find(b"\0", self._place) + 1 - self._place)[:-1].decode("utf-8", "replace")

    def skip(self, size: int) -> bytes:
        if not 0 <= size <= len(self._data) - self._place:
            raise ValueError(f"{self._path} is damaged: it ends within a record; export the model again")
        self._place += size
        return self._data[self._place - size : self._place]


def is_model(folder: Path) -> bool:
    return any(all((folder / name).is_file() for name in names) for names in (TEXT, BINARY))


def load_colmap(folder: Path) -> SparseModel:
    """Read a model, from binary files if they exist, as COLMAP does, else from text; ValueError if it is damaged."""
    is_binary = all((folder / name).is_file() for name in BINARY)
    cameras_file, images_file = (folder / name for name in (BINARY if is_binary else TEXT))
    cameras, images = load_cameras(cameras_file), (_binary_images if is_binary else _text_images)(images_file)
    if not images:
        raise ValueError(f"{folder} has no images with a pose: register some, or give another model")
    names, ids, poses = (list(column) for column in zip(*images, strict=True))
    if missing := sorted({*ids} - cameras.keys()):
        raise ValueError(f"{folder}: images are of camera {missing[0]}, which has no line: export the model again")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{folder} has {twice[0]} twice: export the model again")
    return SparseModel(cameras, names, ids, np.linalg.inv(poses), (cameras_file, images_file))


def load_cameras(path: Path) -> dict[int, Calibration]:
    """Read the cameras of cameras.txt or cameras.bin, by id."""
    return (_binary_cameras if path.suffix.lower() == ".bin" else _text_cameras)(path)


def _binary_cameras(path: Path) -> dict[int, Calibration]:
    cameras, names = {}, [*MODELS]
    for record in _Records(path):
        key, number, *size = record.values("IiQQ")
        if not 0 <= number < len(names) or key in cameras:
            raise ValueError(f"{path} is damaged: camera {key} is there twice or of no model; export it again")
        params = record.values(f"{len(MODELS[names[number]].split())}d")
        cameras[key] = from_colmap(names[number], params, size_of(*size, path), path)
    return cameras


def _text_cameras(path: Path) -> dict[int, Calibration]:
    cameras: dict[int, Calibration] = {}
    for number, line in enumerate(reading.read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or not words[0].isdecimal() or int(words[0]) in cameras:
            raise ValueError(f"{path}:{number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}")
        key, model, width, height, *params = words
        size = size_of(*(as_number(side, "a side", path) for side in (width, height)), path)
        cameras[int(key)] = from_colmap(model, params, size, path)
    return cameras


def _binary_images(path: Path) -> list[Image]:
    """Read images.bin; COLMAP documents its layout."""
    images = []
    for record in _Records(path):
        number, *values, camera = record.values("I7dI")
        name = record.text()
        record.skip(POINT_SIZE * record.values("Q")[0])
        images.append((name, camera, _pose(values, f"{path}, image {number}")))
    return images


def _text_images(path: Path) -> list[Image]:
    images = []
    lines = enumerate(reading.read_text(path).splitlines(), start=1)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words, place = line.strip().split(maxsplit=9), f"{path}:{number}"
        try:
            values, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9]
        except (ValueError, IndexError) as error:
            raise ValueError(
                f"{place}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r} ({error}): "
                "export the model again"
            ) from error
        images.append((name, camera, _pose(values, place)))
        after, points = next(lines, (number + 1, ""))
        words = points.split()
        if len(words) % 3 or (words and not words[-1].removeprefix("-").isdecimal()):  # a name of three words
            raise ValueError(
                f"{path}:{after}: expected the points of image {name} (X Y POINT3D_ID each) or an empty line, "
                f"got {points[:80]!r}: every image has two lines"
            )
    return images


def _pose(values: Sequence[float], place: str) -> np.ndarray:
    """World → camera (4, 4) from QW QX QY QZ TX TY TZ."""
    w, x, y, z, *position = values
    try:
        return reading.rigid(position, (x, y, z, w))
    except ValueError as error:
        raise ValueError(f"{place}: the pose is not finite or {error}: export the model again") from error


def check_whole(folder: Path) -> None:
    """Raise ValueError if binary files of a model end too soon: pycolmap would hang."""
    for path in sorted(folder.glob("*.bin")):
        if path.stem in _CHECKED:
            _CHECKED[path.stem](path)


def _check_rigs(path: Path) -> None:
    for record in _Records(path):
        _, count = record.values("II")
        for number in range(count):
            record.values("iI")
            if number and record.values("?")[0]:
                record.values("7d")


_CHECKED: dict[str, Callable[[Path], object]] = {
    "cameras": _binary_cameras,
    "images": _binary_images,
    "points3D": lambda path: [record.skip(8 * record.values("43xQ")[0]) for record in _Records(path)],
    "rigs": _check_rigs,
    "frames": lambda path: [record.skip(16 * record.values("II7dI")[-1]) for record in _Records(path)],
}
