"""Interface of a data set: frames in order, their calibration and ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from tqdm import tqdm

# Values of `Frame.moving`: what a pixel shows stays, moves, or will stand elsewhere.
STAYS, MOVES, ELSEWHERE = range(3)


class BadFrameError(ValueError):
    """A frame that cannot be used: unreadable, truncated or of the wrong size; the message names its file."""


@dataclass(frozen=True)
class Frame:
    """One image and what is known about it; every array has the data set's `size`."""

    index: int  # position among the images in use, from 0 (after `start`, `stop`, `stride`)
    timestamp: float  # seconds, or without any the number or the time in the file name
    name: str  # path of the image file, for messages
    image: np.ndarray  # RGB, uint8 (h, w, 3)
    depth: np.ndarray | None = None  # true camera-space z in metres, float32 (h, w), 0 = no value
    T_world_camera: np.ndarray | None = None  # true pose of the colour camera, OpenCV axes, float64 (4, 4)
    labels: np.ndarray | None = None  # true class per pixel, int32 (h, w), -1 = none
    moving: np.ndarray | None = None  # STAYS, MOVES or ELSEWHERE, uint8 (h, w); None where all stays
    mask: np.ndarray | None = None  # True where the image is not used, bool (h, w)

    @property
    def static_depth(self) -> np.ndarray | None:
        """`depth` of what stays, 0 elsewhere: maps are compared with it."""
        return self.depth if self.moving is None else np.where(self.moving == STAYS, self.depth, np.float32(0.0))


@dataclass(frozen=True)
class Rates:
    """How the images of a camera are mapped: maps a second of late, images dropped so far, seconds behind."""

    maps_per_second: float
    num_dropped: int
    behind_s: float

    def __str__(self) -> str:
        return f"{self.maps_per_second:.1f} maps/s, {self.num_dropped} dropped, {self.behind_s:.1f} s behind"


@runtime_checkable
class Dataset(Protocol):
    """A sequence of frames. Construction checks the layout; `dataset[i]` reads frame i and may raise BadFrameError.

    `pose(i)` reads no image, so that the whole trajectory is checked first: T_world_camera, float64 (4, 4), or None; it
    may raise BadFrameError. A subclass has no ground truth and no files unless it says so.
    """

    name: str  # e.g. "seven_scenes"
    sequence: str  # e.g. "redkitchen/seq-01"
    size: tuple[int, int]  # (width, height) of every frame
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels at `size`, pixel centres at integers
    calibration: Mapping[str, Any] = MappingProxyType({})  # origin of `intrinsics` for metrics.json, `note` for people
    full_intrinsics: tuple[float, float, float, float] | None = None  # of `full`; None if it is the frame's image
    classes: tuple[str, ...] = ()  # names of the labels
    all_names: Sequence[str] = ()  # names without suffix of all images, in use or not; empty if not known
    is_turned: bool = True  # images are shown as their EXIF turns them; False: as they are stored
    has_ground_truth: bool = False  # depth and poses

    def __len__(self) -> int:
        """Number of frames; of a camera's, those that have come so far."""
        ...

    def __getitem__(self, index: int) -> Frame: ...

    def has(self, index: int) -> bool:
        """Test whether there is a frame `index`; waits for it while more may come."""
        return index < len(self)

    def drop_last(self) -> None:
        """Leave out the last frame that has come, as if it had not; only while more may come."""
        raise NotImplementedError

    @property
    def total(self) -> int | None:
        """Number of frames; None while more may come."""
        return len(self)

    def begin(self) -> None:
        """Be told that mapping begins now."""

    def progress_words(self, index: int) -> str:
        """Return words for the progress bar after frame `index` is mapped."""
        return ""

    @property
    def rates(self) -> Rates | None:
        """How the last frame was mapped, of which `progress_words` was told; None where images do not pass."""
        return None

    def report(self) -> dict[str, float]:
        """Return statistics of how the frames came, as keys `camera/…`."""
        return {}

    def recording(self) -> Mapping[str, Any] | None:
        """Return settings that read the same frames again; None if they are those of this data set, or none do."""
        return None

    def full(self, index: int) -> np.ndarray:
        """RGB image of a frame, uint8, at its size on disk, undistorted. May raise BadFrameError."""
        return self[index].image

    def pose(self, index: int) -> np.ndarray | None:
        return None

    def files(self, index: int) -> Sequence[Path]:
        """The files of a frame: its image first, then lists and poses; empty if frames are rendered."""
        return ()

    def number(self, index: int) -> int:
        """The number of a frame in its video, if it has no file of its own."""
        return index

    def mask_file(self, index: int) -> Path | None:
        """Return the mask that the data set itself has for frame `index`: what is black in it is left out."""
        return None

    def straight(self, index: int, mask: np.ndarray) -> np.ndarray:
        """Return a mask (h, w) of image `index` as it is on disk as one of its `full` image."""
        return mask

    def stored_pixels(self, index: int) -> np.ndarray | None:
        """Return where in its image on disk each pixel of frame `index` is, as shares of width and height (h, w, 2).

        The image's top left corner is (0, 0), its pixels' centres are at (column + 0.5) / width. None where the image
        is only resized.
        """
        return None

    def pixel_of(self, index: int, pixel: np.ndarray) -> np.ndarray:
        """Return the column and row, in frame `index`, of a pixel (column, row) of its image on disk."""
        return (np.asarray(pixel, np.float64) + 0.5) * self.size / self.raw_size - 0.5

    @property
    def raw_size(self) -> tuple[int, int]:
        """(width, height) of the images on disk."""
        return self.size

    def fingerprint(self) -> str:
        """Hex digest of all that defines the frames (names and contents of files, options), for provenance."""
        ...


def wait_for_all(dataset: Dataset) -> int:
    """Return the number of frames once no more come, with a progress bar where that takes time."""
    with tqdm(initial=len(dataset), unit="image", desc="recording", disable=dataset.total is not None) as bar:
        while dataset.has(len(dataset)):
            bar.update()
    return len(dataset)
