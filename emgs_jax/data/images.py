"""A folder of images or a video file; no ground truth, so no metrics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from emgs_jax.data import reading
from emgs_jax.data.file_names import (
    IMAGE_SUFFIXES,
    check_one_kind,
    frame_name,
    natural_order,
    taken_note,
    times_of,
    unread_note,
)
from emgs_jax.data.intrinsics import ALTERNATIVES, Given, Pictures, find_lens
from emgs_jax.data.straightened import Straightened
from emgs_jax.data.tones import read_shown, tones_of
from emgs_jax.data.video import VIDEO_SUFFIXES, Video

LAYOUT = (
    "root[/sequence] = a folder of png, jpg, webp, bmp or tiff images, or a video file (mp4, mov, m4v, avi, mkv, webm)"
)


@dataclass(eq=False)
class Images(Straightened):
    """Your own images, in natural order of their names, or a video; sequence None: root is the folder or file."""

    # Required: fx, fy, cx, cy in pixels of the images on disk, maybe with k1, k2, p1, p2(, k3); a model of COLMAP and
    # its parameters; a calibration file; "exif" or "estimate", see `intrinsics.find_lens`.
    intrinsics: Given | None = None

    name, layout, source = "images", LAYOUT, "your own recording"
    _video = None

    def __post_init__(self) -> None:
        path = self._find(self.sequence or ".")
        if self.intrinsics is None:
            raise ValueError(
                f"dataset.intrinsics is not set for {path}: give {ALTERNATIVES}; where none of them is at hand, "
                "fx = fy = .8 times the width and the centre of the image are a start"
            )
        if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
            self._video = Video(path, reading.limit(self.start, self.stop))
            self._folder, times, notes = path.parent, self._video.times, self._video.notes
            paths = [path] * len(times)
        else:
            self._folder, (paths, times, notes) = path, listed(path)
        self._select(len(paths), f"{path} ({LAYOUT})")
        self.all_names = (
            [frame_name(row) for row in range(self._video.count)] if self._video else [one.stem for one in paths]
        )
        self._images, self._times = ([every[row] for row in self._chosen] for every in (paths, times))
        if self._video is None:
            self._tones = tones_of(self._images)
            notes = [*notes, reading.transparency_note(self._images)]
            raw_size, files = reading.first_size(self._images, path), self._images
        else:
            raw_size, files = self._video.read(self._chosen[0]).shape[1::-1], []
        pictures = Pictures(raw_size, len(self), self._shown, files, f"images of {self._place(0)[1]}", self._chosen)
        self._use(find_lens(self.intrinsics, pictures), raw_size, *notes)

    def _place(self, index: int) -> tuple[float, str]:
        time, name = super()._place(index)
        return time, name if self._video is None else f"{name}, frame {self._chosen[index]}"

    def _shown(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        if self._video is not None:
            return self._video.read(self._chosen[index])
        return read_shown(self._images[index], None, self._tones)

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        image = self._shown(index)
        reading.check_raw_size(image, self._raw_size, self._place(index)[1])
        return image

    def _options(self) -> dict[str, Any]:
        lens = {} if self._lens.maps is None else {"lens": self.calibration["distortion"]}
        return lens | {"frames": (self._chosen.start, self._chosen.stop, self._chosen.step)}


def listed(folder: Path) -> tuple[list[Path], list[float], list[str | None]]:
    """Images of a folder in natural order, the times in their names (`times_of`), and notes on both."""
    if not folder.is_dir():
        raise ValueError(f"{folder} is neither a folder nor a video file; expected {LAYOUT}")
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    order, of_order = natural_order(found)
    paths = [found[row] for row in order]
    check_one_kind(paths)
    times, of_times = times_of(paths)
    notes = [of_order, of_times, taken_note(paths), unread_note(folder)]
    if not paths:
        folders = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
        below = f"it has the folders {', '.join(folders[:5])}: give one of them" if folders else None
        raise ValueError("; ".join(filter(None, (f"{folder} ({LAYOUT}) has no images", below, notes[-1]))))
    return paths, times, notes
