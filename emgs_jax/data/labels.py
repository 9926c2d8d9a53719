"""Images of classes: an id per pixel, and the file that says what the ids mean."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int32

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError


class LabelFolder:
    """Class images in a folder, each with the name of the image that it is of.

    Args:
        folder: of PNG images of ids with one channel, 8 or 16 bits.
        classes: file with a line "id name" for every class, or a line "name" each, whose ids count from 0; lines that
            begin with # say nothing.
        unknown: ids that mean that there is no class.

    Raises:
        ValueError: the folder or the file is not there, or the file names no classes, or an id twice.
    """

    def __init__(self, folder: Path, classes: Path, unknown: Collection[int] = (0,)) -> None:
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder: give one with a class image (PNG) for every image")
        self.folder, self.classes = folder, classes
        ids, self.names = read_classes(classes)
        self._position = {**dict.fromkeys(unknown, -1), **{id_: row for row, id_ in enumerate(ids)}}

    def path(self, image: str | Path) -> Path:
        """The file of an image's classes."""
        return self.folder / f"{Path(image).stem}.png"

    def read(self, image: str | Path, raw_size: tuple[int, int] | None = None) -> Int32[np.ndarray, "h w"]:
        """Position in `names` of each pixel of the image, -1 where there is no class.

        Args:
            image: file of the image, whose name is looked for.
            raw_size: (width, height) that it must have.

        Raises:
            BadFrameError: the file cannot be read, is no image of ids or of another size, or has an id without a name.
        """
        path = self.path(image)
        ids = reading.decode(path, cv2.IMREAD_UNCHANGED)
        if ids.ndim != 2 or ids.dtype not in (np.uint8, np.uint16):
            raise BadFrameError(
                f"{path} must be an image of class ids with one channel of 8 or 16 bits, got {ids.dtype} "
                f"{ids.shape}: write the ids, not their colours"
            )
        reading.check_raw_size(ids, raw_size, path)
        if ids.dtype == np.uint8 and max(self._position) > 255:
            raise BadFrameError(
                f"{path} has 8 bits, but {self.classes} has ids up to {max(self._position)}: write it with 16 bits"
            )
        found = np.unique(ids)
        nameless = [int(id_) for id_ in found if id_ not in self._position]
        if nameless:
            raise BadFrameError(
                f"{path} has the ids {nameless[:5]}, which {self.classes} does not name: add their lines, or say with "
                "`unknown` that they mean no class"
            )
        table = np.full(int(found[-1]) + 1, -1, np.int32)
        table[found] = [self._position[id_] for id_ in found]
        return table[ids]


def read_classes(path: Path) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Ids and names of a file of classes, as `LabelFolder` takes it."""
    if not path.is_file():
        raise ValueError(f"{path} does not exist: give a file with a line 'id name' for every class")
    lines = [line.strip() for line in reading.read_text(path).splitlines()]
    rows = [line.split(maxsplit=1) for line in lines if line and not line.startswith("#")]
    if not rows:
        raise ValueError(f"{path} names no classes: write a line 'id name' for every one")
    if all(len(row) == 2 and row[0].isdecimal() for row in rows):
        ids, names = [int(row[0]) for row in rows], [row[1] for row in rows]
    else:
        ids, names = [*range(len(rows))], [" ".join(row) for row in rows]
    for what, values in (("id", ids), ("name", names)):
        twice = _first_twice(values)
        if twice is not None:
            raise ValueError(f"{path} has the {what} {twice!r} twice: each class needs its own")
    return tuple(ids), tuple(names)


def _first_twice(values: Iterable[object]) -> object | None:
    seen: set[object] = set()
    return next((value for value in values if value in seen or seen.add(value)), None)


def as_unknown(unknown: Sequence[int], key: str) -> tuple[int, ...]:
    """The ids of a config; raises ValueError, which names `key`, where one is no whole number from 0."""
    if isinstance(unknown, str) or any(not isinstance(id_, int) or id_ < 0 for id_ in unknown):
        raise ValueError(f"{key} must be a list of ids, whole numbers from 0, got {unknown}")
    return tuple(unknown)
