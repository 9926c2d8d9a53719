"""Masks: an image for each frame of pixels that are left out, such as people."""

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError, Dataset, Frame
from emgs_jax.data.file_names import IMAGE_SUFFIXES, check_numbering, frame_name
from emgs_jax.data.labels import LabelFolder
from emgs_jax.ops.ranges import ranged

MAX_STRETCH = 0.02  # of a mask and its image: networks round sides to whole patches
JPEG_BLACK = 16  # of 255: compression spreads black into its surroundings and back
MANY = 0.5  # share of an image


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
    def paths(self) -> list[Path]:
        """All images in the folder and below."""
        found = sorted(Path(self.folder).expanduser().rglob("*"))
        return [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]

    def files(self, images: Sequence[Path | None], numbers: Sequence[int], may_lack: bool = False) -> list[Path | None]:
        """The mask of each image, by its name and, where names repeat, its folders; None without a `folder`.

        Args:
            images: file of each; None for a frame of a video, whose mask is named by its number.
            numbers: of each, from 0.
            may_lack: an image without a mask gets None.

        Raises:
            ValueError: an image has no mask, or two images have the same.
        """
        if self.folder is None:
            return [None] * len(images)
        by_end, found = defaultdict(list), []
        for path in self.paths:
            parts = path.relative_to(Path(self.folder).expanduser()).parts
            for begin in range(len(parts)):
                by_end[(*parts[begin:-1], path.stem)].append(path)
        for image, number in zip(images, numbers, strict=True):
            if image is None:
                ends = [(frame_name(number),)]
            else:  # the longest path that a mask ends with; COLMAP's are called NAME.png.png
                above = image.parts[:-1]
                ends = [(*above[row:], name) for row in range(len(above) + 1) for name in (image.stem, image.name)]
            found.append(next((by_end[end][0] for end in ends if len(by_end.get(end, ())) == 1), None))
        missing = [row for row, path in enumerate(found) if path is None]
        if missing and not may_lack:
            image = images[missing[0]]
            name = frame_name(numbers[missing[0]]) if image is None else image.stem
            raise ValueError(
                f"masks.folder={self.folder} has no mask for {name} (and {len(missing) - 1} more): give a "
                f"folder with one image for each frame, {name}.png"
            )
        if None in images:
            self._check_first(set(numbers))
        path, count = Counter(filter(None, found)).most_common(1)[0]
        if count > 1 and None not in images:
            raise ValueError(f"{path} is the mask of {count} images: put masks into folders with the names of theirs")
        return found

    def _check_first(self, used: set[int]) -> None:
        """ValueError where masks of a video are numbered from 1, as ffmpeg does, and not those of the frames in use."""
        there = {int(path.stem) for path in self.paths if path.stem.isdecimal()}
        if 1 in there and 0 not in there and there != used:
            raise ValueError(
                f"masks.folder={self.folder} has masks from 1 on, and frames of a video are numbered from 0: call the "
                "first one 000000.png (ffmpeg: -start_number 0)"
            )

    def decoded(self, path: Path, size: tuple[int, int], image: Path | None = None) -> Bool[np.ndarray, "h w"]:
        """What is left out of an image of (width, height) `size`, without the border.

        Args:
            image: its file. A mask of the pixels as they are stored is turned as the EXIF of the image says.

        Raises:
            BadFrameError: the mask cannot be read, or has other sides than its image.
        """
        if self.classes is None:
            values = reading.decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
            is_out = values <= (JPEG_BLACK if path.suffix.lower() in (".jpg", ".jpeg") else 0)
        else:
            is_out = np.isin(self._labels.read(path), [self._labels.names.index(one) for one in self.classes])
        if reading.stretch(is_out.shape[::-1], size) > MAX_STRETCH and image is not None:
            is_out = _turned(is_out, reading.orientation(image))
        if reading.stretch(is_out.shape[::-1], size) > MAX_STRETCH or is_out.shape[1] < 16:
            (height, width), turned = is_out.shape, "; it is turned" if is_out.shape == tuple(size) else ""
            raise BadFrameError(
                f"{path} is {width}x{height}, but its image is {size[0]}x{size[1]}{turned}: make it of that size"
            )
        return resized(is_out, size)

    def fitted(self, is_out: Bool[np.ndarray, "_ _"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
        """A mask for an image of (width, height) `size`, with the border."""
        kernel = np.ones((2 * self.border + 1,) * 2, np.uint8)
        return cv2.dilate(np.uint8(resized(is_out, size)), kernel) > 0

    def reader(
        self, images: Sequence[Path | None], numbers: Sequence[int], size: tuple[int, int]
    ) -> Callable[[int], Bool[np.ndarray, "h w"] | None]:
        """A function that reads the mask of image 0 .. n-1, of `size` on disk, with the border; else as `files`."""
        files = self.files(images, numbers)
        return lambda row: files[row] and self.fitted(self.decoded(files[row], size, images[row]), size)

    def read(self, name: str, size: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
        """What is left out of the image of this name, without suffix, and (width, height) `size`; as `reader`."""
        return self.reader([Path(f"{name}.png")], [0], size)(0)

    def fingerprint(self) -> list[object]:
        """What the masks depend on: options, and the names and contents of files."""
        if self.folder is None:
            return []
        digest = hashlib.blake2b(digest_size=16)
        for path in self.paths:
            digest.update(path.name.encode() + reading.read_bytes(path))
        return [digest.hexdigest(), self.classes and [*self.classes], self.border]


def resized(is_out: Bool[np.ndarray, "_ _"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A mask in (width, height) `size`; a pixel that covers some of what is left out is left out."""
    return cv2.resize(np.uint8(255 * is_out), size, interpolation=cv2.INTER_AREA) > 0


def _turned(values: np.ndarray, orientation: int) -> np.ndarray:
    """Values as an image of this EXIF orientation is shown; only turns by 90 degrees, which the sides tell."""
    turns = {5: (0, True), 6: (3, False), 7: (2, True), 8: (1, False)}  # quarters to the left, then transposed
    quarters, is_transposed = turns.get(orientation, (0, False))
    found = np.rot90(values, quarters)
    return np.ascontiguousarray(found.T if is_transposed else found)


def masked(frame: Frame, is_out: Bool[np.ndarray, "h w"]) -> Frame:
    """Add a mask to a frame, and remove the truth there."""
    depth = None if frame.depth is None else np.where(is_out, np.float32(0.0), frame.depth)
    labels = None if frame.labels is None else np.where(is_out, np.int32(-1), frame.labels)
    return replace(frame, depth=depth, labels=labels, mask=is_out)


def names_of(dataset: Dataset) -> list[str]:
    """A name for each frame in use: its file's, or its number in a video."""
    return image_names(*files_of(dataset))


def files_of(dataset: Dataset) -> tuple[list[Path | None], list[int]]:
    """The image file of each frame in use, None if it has none of its own, and its number."""
    files = [next(iter(dataset.files(index)), None) for index in range(len(dataset))]
    numbers = [*map(getattr(dataset, "number", int), range(len(dataset)))]
    return (files if len({*files}) == len(files) else [None] * len(files)), numbers


def check_names(dataset: Dataset, given: Collection[str], where: object) -> None:
    """Raise ValueError if `given`, names of images without suffix in `where`, are those of each frame's neighbour."""
    used = names_of(dataset)
    check_numbering([stem(f"{name}.png") for name in getattr(dataset, "all_names", ())], used, given, where)
    first, second = map(frame_name, (0, 1))
    if files_of(dataset)[0][0] is None and first in used and first not in given and second in given:
        raise ValueError(
            f"{where} has names from {second} on, and frames of a video are numbered from {first}: call its first one "
            f"{first} (ffmpeg: -start_number 0); if that is the video's second frame, dataset.start=1 says so"
        )


def image_names(files: Sequence[Path | None], numbers: Sequence[int]) -> list[str]:
    """Stems of the files if they are distinct, else the numbers."""
    stems = [stem(path.name) if path is not None else "" for path in files]
    return stems if all(stems) and len({*stems}) == len(stems) else [*map(frame_name, numbers)]


def stem(name: str) -> str:
    """Name of an image without folder, suffix, and characters that COLMAP's lists of pairs cannot hold."""
    return re.sub(r"[\s#]", "_", name.rpartition("/")[2].rpartition(".")[0] or name)
