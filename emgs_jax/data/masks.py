"""Masks: an image for each frame of pixels that are left out, such as people."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError, Dataset, Frame
from emgs_jax.data.labels import LabelFolder
from emgs_jax.ops.ranges import ranged

MAX_STRETCH = 0.02  # relative difference in aspect of a mask and its image


@dataclass(frozen=True)
class Masks:
    """Masks in a folder, each with its image's name and aspect."""

    folder: str | None = None  # of images; None: no masks
    # classes that are left out, if the images hold ids, see `LabelFolder`; None: black is left out, as for COLMAP
    classes: Sequence[str] | None = None
    names: str | None = None  # file that names the ids, see `data.class_file`; needed with `classes`
    border: int = field(default=2, metadata=ranged(low=0, high=1000))  # pixels by which masks are dilated

    def __post_init__(self) -> None:
        if self.classes is None:
            return
        if self.folder is None or self.names is None:
            raise ValueError("masks.classes goes with masks.folder, and masks.names, the file that names the ids")
        unknown = [name for name in self.classes if name not in self._labels.names]
        if unknown or isinstance(self.classes, str):
            raise ValueError(
                f"masks.classes={self.classes}: {unknown} are no classes of {self.names}, which has "
                f"{', '.join(self._labels.names)}"
            )

    @cached_property
    def _labels(self) -> LabelFolder:
        return LabelFolder(Path(self.folder).expanduser(), Path(self.names).expanduser(), None)

    @cached_property
    def _files(self) -> dict[str, Path]:
        """Masks by the name of the image, with or without its suffix."""
        folder = Path(self.folder).expanduser()
        return {stem(path.name): path for path in sorted(folder.iterdir())} if folder.is_dir() else {}

    def check(self, names: Sequence[str]) -> None:
        """Raise ValueError if an image of these names has no mask."""
        missing = [] if self.folder is None else [name for name in names if self._file(name) is None]
        if missing:
            raise ValueError(
                f"masks.folder={self.folder} has no mask for {missing[0]} (and {len(missing) - 1} more): give a "
                f"folder with one image for each frame, {missing[0]}.png"
            )

    def _file(self, name: str) -> Path | None:
        return self._files.get(name, self._files.get(f"{name}.png"))

    def read(self, name: str, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
        """True where an image of `size` is left out; BadFrameError if its mask cannot be read or has another aspect."""
        if self.folder is None:
            return np.zeros(size[::-1], bool)
        self.check([name])
        path = self._file(name)
        if self.classes is None:
            is_out = reading.decode(path, cv2.IMREAD_GRAYSCALE) == 0
        else:
            is_out = np.isin(self._labels.read(path), [self._labels.names.index(one) for one in self.classes])
        (height, width), turned = is_out.shape, "; it is turned" if is_out.shape == size else ""
        if abs(width * size[1] / (height * size[0]) - 1.0) > MAX_STRETCH or width < 16:
            raise BadFrameError(
                f"{path} is {width}x{height}, but its image is {size[0]}x{size[1]}{turned}: make it of that size"
            )
        image = cv2.resize(np.uint8(255 * is_out), size, interpolation=cv2.INTER_AREA)
        return cv2.dilate(image, np.ones((2 * self.border + 1,) * 2, np.uint8)) > 0


def masked(frame: Frame, is_out: Bool[np.ndarray, "h w"]) -> Frame:
    """Add a mask to a frame, and remove the truth there."""
    depth = None if frame.depth is None else np.where(is_out, np.float32(0.0), frame.depth)
    labels = None if frame.labels is None else np.where(is_out, np.int32(-1), frame.labels)
    return replace(frame, depth=depth, labels=labels, mask=is_out)


def names_of(dataset: Dataset) -> list[str]:
    """A name for each frame in use: its file's, or its number in a video."""
    files = [dataset.files(index) for index in range(len(dataset))]
    numbers = [*map(getattr(dataset, "number", int), range(len(dataset)))]
    return image_names([found[0] if found else None for found in files], numbers)


def image_names(files: Sequence[Path | None], numbers: Sequence[int]) -> list[str]:
    """Stems of the files if they are distinct, else the numbers."""
    stems = [stem(path.name) if path is not None else "" for path in files]
    return stems if all(stems) and len({*stems}) == len(stems) else [f"{number:06d}" for number in numbers]


def stem(name: str) -> str:
    """Name of an image without folder, suffix, and characters that COLMAP's lists of pairs cannot hold."""
    return re.sub(r"[\s#]", "_", name.rpartition("/")[2].rpartition(".")[0] or name)
