"""A folder of images or a video file; no ground truth, so no metrics."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from emgs_jax.data import reading
from emgs_jax.data.file_names import IMAGE_SUFFIXES, check_one_kind, natural_order, taken_note, times_of, unread_note
from emgs_jax.data.intrinsics import ALTERNATIVES, Given, Pictures, find_lens
from emgs_jax.data.reading import Size
from emgs_jax.data.straightened import Straightened
from emgs_jax.data.tones import Tones, read_shown, tones_of
from emgs_jax.data.video import VIDEO_SUFFIXES, Video

LAYOUT = (
    "root[/sequence] = a folder of png, jpg, webp, bmp or tiff images, or a video file (mp4, mov, m4v, avi, mkv, webm)"
)


class Images(Straightened):
    """Your own images.

    Args:
        root: folder of images or video file.
        sequence: folder or file below root; None = root itself.
        start, stop, stride: which of the images that are there, in natural order of their names.
        size: (width, height) of the frames given out; another aspect than the images' is allowed (fx and fy follow).
        intrinsics: required. fx, fy, cx, cy in pixels of the images on disk, where they are distorted followed by k1,
            k2, p1, p2 and maybe k3; the name of a model of COLMAP and its parameters; or a calibration file, "exif" or
            "estimate", see `intrinsics.find_lens`.
    """

    name = "images"

    def __init__(
        self,
        root: str | None = None,
        sequence: str | None = None,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Sequence[int] = (320, 240),
        intrinsics: Given | None = None,
    ) -> None:
        path = reading.find_sequence(root, "." if sequence is None else sequence, LAYOUT, "your own recording")
        if intrinsics is None:
            raise ValueError(
                f"dataset.intrinsics is not set for {path}: give {ALTERNATIVES}; where none of them is at hand, "
                "fx = fy = .8 times the width and the centre of the image are a start"
            )
        is_video = path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()
        self._source = Video(path, reading.limit(start, stop)) if is_video else Folder(path)
        self._chosen = reading.select(self._source.count, start, stop, stride, f"{path} ({LAYOUT})")
        raw_size = self._source.find_size(self._chosen)
        self._folder, self._tones = self._source.folder, self._source.tones
        self.sequence = path.name if sequence is None else str(sequence)
        lens = find_lens(intrinsics, self._pictures(raw_size))
        self._use(lens, raw_size, size, *self._source.notes)

    def _pictures(self, size: Size) -> Pictures:
        files = [] if isinstance(self._source, Video) else [self._source.file(row) for row in self._chosen]
        name = f"images of {self._source.label(self._chosen[0])}" if len(self) else "images"
        return Pictures(size, len(self), lambda index: self._source.read(self._chosen[index]), files, name)

    def __len__(self) -> int:
        return len(self._chosen)

    def _place(self, index: int) -> tuple[float, str]:
        row = self._chosen[index]
        return self._source.timestamp(row), self._source.label(row)

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        row = self._chosen[index]
        image = self._source.read(row)
        reading.check_raw_size(image, self._raw_size, self._source.label(row))
        return image

    def files(self, index: int) -> list[Path]:
        return [self._source.file(self._chosen[index])]

    def _options(self) -> dict[str, Any]:
        lens = {} if self._lens.maps is None else {"lens": self.calibration["distortion"]}
        return lens | {"frames": (self._chosen.start, self._chosen.stop, self._chosen.step)}


class Folder:
    """Images of a folder in natural order, at the times in their names (`times_of`)."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ValueError(f"{folder} is neither a folder nor a video file; expected {LAYOUT}")
        found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
        self.folder = folder
        order, of_order = natural_order(found)
        self._paths = [found[row] for row in order]
        self.count = len(self._paths)
        check_one_kind(self._paths)
        self._times, note = times_of(self._paths)
        self.notes: list[str | None] = [of_order, note, taken_note(self._paths), unread_note(folder)]
        if not self._paths:
            folders = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
            below = f"it has the folders {', '.join(folders[:5])}: give one of them" if folders else None
            raise ValueError("; ".join(filter(None, (f"{folder} ({LAYOUT}) has no images", below, self.notes[-1]))))
        self.tones: Tones | None = None  # of the images in use

    def find_size(self, rows: range) -> Size:
        self.tones = tones_of([self._paths[row] for row in rows])
        self.notes.append(reading.transparency_note(self._paths[row] for row in rows))
        return reading.first_size((self._paths[row] for row in rows), self.folder)

    def read(self, row: int) -> UInt8[np.ndarray, "_ _ 3"]:
        return read_shown(self._paths[row], None, self.tones)

    def timestamp(self, row: int) -> float:
        return self._times[row]

    def file(self, row: int) -> Path:
        return self._paths[row]

    def label(self, row: int) -> str:
        return str(self._paths[row])
