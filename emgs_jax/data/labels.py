"""Class images: an id per pixel, and a file that names the ids."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int32

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.class_file import read_classes


class LabelFolder:
    """Class images in a folder, named like their images: PNG of ids with one channel, 8 or 16 bits.

    Args:
        classes: file that names the ids, see `data.class_file`; names without ids count from 0.
        unknown: ids that mean no class, named or not; None: 0, unless it has a name.
        key: of the config for `unknown`, for messages.

    Raises:
        ValueError: folder or file are missing, or the file names no classes or an id twice.
    """

    def __init__(self, folder: Path, classes: Path, unknown: Collection[int] | None = None, key: str = "") -> None:
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder: give one with a class image (PNG) for every image")
        self.folder, self.classes = folder, classes
        self._remedy = f", or say with {key}=[…] which ids mean no class" if key else ""
        known = read_classes(classes)
        self.names = known.names
        positions = {row: row for row in range(len(self.names))} if known.positions is None else known.positions
        named = {id_: position for id_, position in positions.items() if position >= 0}
        without = dict.fromkeys((0,) if unknown is None else unknown, -1)
        self._known = replace(known, positions=without | named if unknown is None else named | without)
        self._largest_id = max(self._known.positions or ())

    def path(self, image: str | Path) -> Path:
        return self.folder / f"{Path(image).stem}.png"

    def read(self, image: str | Path, raw_size: tuple[int, int] | None = None) -> Int32[np.ndarray, "h w"]:
        """Read the position in `names` of each pixel, -1 = no class; BadFrameError if the file cannot be used."""
        path = self.path(image)
        ids = reading.decode(path, cv2.IMREAD_UNCHANGED)
        if ids.ndim != 2 or ids.dtype not in (np.uint8, np.uint16):
            raise BadFrameError(
                f"{path} must be an image of class ids with one channel of 8 or 16 bits, got {ids.dtype} "
                f"{ids.shape}: write the ids, not their colours"
            )
        reading.check_raw_size(ids, raw_size, path)
        if ids.dtype == np.uint8 and self._largest_id > 255:
            raise BadFrameError(f"{path} has 8 bits, {self.classes} ids to {self._largest_id}: write it with 16 bits")
        try:
            return self._known.positions_of(ids, path).astype(np.int32)
        except ValueError as error:
            raise BadFrameError(f"{error}{self._remedy}") from error


def as_unknown(unknown: Sequence[int] | None, key: str) -> tuple[int, ...] | None:
    """Check ids from the `key` of a config; None if it has none."""
    if unknown is None:
        return None
    is_list = isinstance(unknown, Sequence) and not isinstance(unknown, str)
    if not is_list or any(not isinstance(id_, int) or id_ < 0 for id_ in unknown):
        raise ValueError(f"{key} must be a list of ids, whole numbers from 0, got {unknown}")
    return tuple(unknown)
