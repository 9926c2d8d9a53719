"""Base of the data sets on disk: their images straightened, in the size in use."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from emgs_jax.data import reading
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.intrinsics import Lens, with_notes
from emgs_jax.data.reading import Size
from emgs_jax.data.tones import Tones


class Straightened(Dataset):
    """Frames whose images are read, straightened by one lens and resized; the rest of them where a subclass has it.

    A subclass sets `sequence`, `_folder` (of the files) and, where there is one, `_tones`, calls `_use`, and defines
    `__len__`, `_read`, `_place` and `files`.
    """

    _folder: Path
    _tones: Tones | None = None

    def _use(self, lens: Lens, raw_size: Size, size: Sequence[int], *notes: str | None) -> None:
        """Straighten by `lens` what is `raw_size` on disk, and give it out in `size`; `notes` are on the images."""
        self._lens, self._raw_size, self.size = lens, raw_size, reading.check_size(size)
        self.calibration = with_notes(lens.about, self._tones and self._tones.note, *notes)
        self.full_intrinsics = lens.intrinsics
        self.intrinsics = reading.resize_intrinsics(lens.intrinsics, raw_size, self.size)

    def __getitem__(self, index: int) -> Frame:
        reading.check_index(index, len(self))
        image = reading.resize_color(self.full(index), self.size)
        depth, pose, labels = self._depth(index), self.pose(index), self._labels_of(index)
        return Frame(index, *self._place(index), image, depth, pose, labels)

    def full(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        return self._lens.straighten(self._read(index))

    def fingerprint(self) -> str:
        options = {"dataset": self.name, "size": self.size, "intrinsics": self.intrinsics} | self._options()
        options |= {} if self._tones is None else {"tones": self._tones}
        return reading.fingerprint(self._folder, self._fingerprinted(), options)

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """The image as it is on disk, RGB."""
        raise NotImplementedError

    def _place(self, index: int) -> tuple[float, str]:
        """Time and name of a frame."""
        raise NotImplementedError

    def _depth(self, index: int) -> Float32[np.ndarray, "h w"] | None:
        return None

    def _labels_of(self, index: int) -> Int32[np.ndarray, "h w"] | None:
        return None

    def _options(self) -> dict[str, Any]:
        """What else the frames depend on, beside the content of their files."""
        return {}

    def _fingerprinted(self) -> Iterable[Path]:
        """The files whose content counts."""
        return reading.all_files(self)
