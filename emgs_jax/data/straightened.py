"""Base of the data sets on disk: images are chosen, undistorted and resized."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from emgs_jax.data import reading
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.intrinsics import Lens, with_notes
from emgs_jax.data.reading import Size
from emgs_jax.data.tones import read_shown

NUM_LENSES = 8  # whose tables are kept: an image, its depth and its mask have the same


@dataclass(eq=False)
class Straightened(Dataset):
    """Frames whose images are read, undistorted by one lens and resized, maybe with depth.

    A subclass is a dataclass of options. It calls `_find`, `_select` and `_use`, and sets `_folder` (to which the
    fingerprint's file names are relative), `_images`, `_times` and the attributes below.
    """

    root: str | None = None  # folder of the data set
    sequence: str | None = None  # folder below root; None: root itself, if a subclass allows it
    start: int = 0  # start, stop, stride: the images in use
    stop: int | None = None
    stride: int = 1
    size: Sequence[int] = (320, 240)  # (width, height) of the frames, at any aspect

    layout = source = ""  # for messages: expected files, and their origin
    _tones = None  # of images with more than 8 bits
    _flags = 0  # of OpenCV's decoder
    _depths = None  # file of each image or None; None without depths
    _depth_scale = 1.0  # raw units per metre
    _cameras = None  # of each image; None = all are of one
    _files = ()  # that all frames depend on

    def _find(self, sequence: str | None) -> Path:
        """The folder or file of the sequence, which gets its name if it has none."""
        found = reading.find_sequence(self.root, sequence, self.layout, self.source)
        self.sequence = found.resolve().name if self.sequence is None else str(self.sequence)
        return found

    def _select(self, count: int, where: object) -> range:
        self._chosen = reading.select(count, self.start, self.stop, self.stride, where)
        return self._chosen

    def _use(self, lens: Lens, raw_size: Size, *notes: str | None) -> None:
        """Set the lens and the size of the images on disk, with notes on them."""
        self._lens, self._raw_size, self.size = lens, raw_size, reading.check_size(self.size)
        self._lens_of = lru_cache(NUM_LENSES)(lambda camera: lens.of(camera, raw_size))
        self.calibration = with_notes(lens.about, self._tones and self._tones.note, *notes)
        self.full_intrinsics = lens.intrinsics
        self.intrinsics = reading.resize_intrinsics(lens.intrinsics, raw_size, self.size)

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> Frame:
        reading.check_index(index, len(self))
        image = reading.resize_color(self.full(index), self.size)
        depth, pose, labels = self._depth(index), self.pose(index), self._labels_of(index)
        return Frame(index, *self._place(index), image, depth, pose, labels)

    def full(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        return self._lens_at(index).straighten(self._read(index))

    @property
    def raw_size(self) -> Size:
        return self._raw_size

    def straight(self, index: int, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        return self._lens_at(index).straighten_mask(mask)

    def stored_pixels(self, index: int) -> Float32[np.ndarray, "h w 2"] | None:
        found = self._lens_at(index).distorted_pixels(self.size)
        return None if found is None else (found + 0.5) / np.float32(self._raw_size)

    def pixel_of(self, index: int, pixel: np.ndarray) -> np.ndarray:
        return super().pixel_of(index, self._lens_at(index).straight_pixel(pixel))

    def _lens_at(self, index: int) -> Lens:
        return self._lens if self._cameras is None else self._lens_of(self._cameras[index])

    def number(self, index: int) -> int:
        return self._chosen[index]

    def files(self, index: int) -> list[Path]:
        depth = None if self._depths is None else self._depths[index]
        return [self._images[index], *([] if depth is None else [depth]), *self._files]

    def fingerprint(self) -> str:
        options = {"dataset": self.name, "size": self.size, "intrinsics": self.intrinsics} | self._options()
        options |= {} if self._tones is None else {"tones": self._tones}
        return reading.fingerprint(self._folder, self._fingerprinted(), options)

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """The image on disk, RGB."""
        return read_shown(self._images[index], self._raw_size, self._tones, self._flags)

    def _place(self, index: int) -> tuple[float, str]:
        """Time and name of a frame."""
        return float(self._times[index]), str(self._images[index])

    def _depth(self, index: int) -> Float32[np.ndarray, "h w"] | None:
        if self._depths is None:
            return None
        if self._depths[index] is None:
            return np.zeros(self.size[::-1], np.float32)
        raw = reading.read_depth(self._depths[index], self._depth_scale, self._raw_size)
        return reading.resize_nearest(self._lens_at(index).straighten_depth(raw), self.size)

    def _labels_of(self, index: int) -> Int32[np.ndarray, "h w"] | None:
        return None

    def _options(self) -> dict[str, Any]:
        """What the frames depend on beside their files' content, for the fingerprint."""
        return {}

    def _fingerprinted(self) -> Iterable[Path]:
        """The files for the fingerprint."""
        return {file for index in range(len(self)) for file in self.files(index)}
