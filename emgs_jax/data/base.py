"""Interface of a data set: frames in order, their calibration and, where it is known, the ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np

# Values of `Frame.moving`: what a pixel shows stands where it stays, moves, or stands elsewhere later.
STAYS, MOVES, ELSEWHERE = range(3)


class BadFrameError(ValueError):
    """A frame that is there but cannot be used: unreadable, truncated or of the wrong size. Names the file."""


@dataclass(frozen=True)
class Frame:
    """One image and what is known about it; every array has the data set's `size`."""

    index: int  # position among the images in use, from 0 (after `start`, `stop`, `stride`)
    timestamp: float  # seconds of the data set, or the number or the time in the file name where it has none
    name: str  # path of the image file, for messages
    image: np.ndarray  # RGB, uint8 (h, w, 3)
    depth: np.ndarray | None = None  # camera-space z in metres, float32 (h, w), 0 = no value; None without ground truth
    # true pose of the colour camera, OpenCV axes, float64 (4, 4); None without ground truth
    T_world_camera: np.ndarray | None = None
    labels: np.ndarray | None = None  # semantic class per pixel, int32 (h, w), -1 = none; None without labels
    # what each pixel shows: STAYS, MOVES or ELSEWHERE, uint8 (h, w); None where all stays
    moving: np.ndarray | None = None
    mask: np.ndarray | None = None  # True where nothing of the image is used, bool (h, w); None without masks

    @property
    def static_depth(self) -> np.ndarray | None:
        """`depth` of what stays, 0 elsewhere: what maps are compared with."""
        return self.depth if self.moving is None else np.where(self.moving == STAYS, self.depth, np.float32(0.0))


@runtime_checkable
class Dataset(Protocol):
    """A sequence of frames. Construction checks the layout; `dataset[i]` reads frame i and may raise BadFrameError.

    With ground truth also `pose(i)`, which reads no image, so that the whole trajectory is checked before the first
    frame: T_world_camera, float64 (4, 4), or None where there is no truth for this frame. It may raise BadFrameError.
    A subclass has no ground truth and no files unless it says so.
    """

    name: str  # e.g. "seven_scenes"
    sequence: str  # e.g. "redkitchen/seq-01"
    size: tuple[int, int]  # (width, height) of every frame
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels at `size`, pixel centres at integers
    # where `intrinsics` are from, plain values for metrics.json; `note` if worth a line
    calibration: Mapping[str, Any] = MappingProxyType({})
    full_intrinsics: tuple[float, float, float, float] | None = None  # of `full`; None where it is the frame's image
    classes: tuple[str, ...] = ()  # names of the labels; empty without semantics
    has_ground_truth: bool = False  # depth and poses are there

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame: ...

    def full(self, index: int) -> np.ndarray:
        """RGB image of frame `index` as large as it is on disk, straight; uint8. May raise BadFrameError."""
        return self[index].image

    def pose(self, index: int) -> np.ndarray | None:
        return None

    def files(self, index: int) -> Sequence[Path]:
        """Return the files of frame `index`: its image first, then lists and poses; empty where frames are made."""
        return ()

    def number(self, index: int) -> int:
        """Return the number of frame `index` where it has no file of its own: in the video that it is from."""
        return index

    def mask_file(self, index: int) -> Path | None:
        """Return the mask that the data set itself has for frame `index`: what is black in it is left out."""
        return None

    def straight(self, index: int, mask: np.ndarray) -> np.ndarray:
        """Return a mask (h, w) of image `index` as it is on disk as one of its `full` image."""
        return mask

    @property
    def raw_size(self) -> tuple[int, int]:
        """(width, height) of the images on disk."""
        return self.size

    def fingerprint(self) -> str:
        """Hex digest over what defines the frames (files' names and contents, options), for provenance."""
        ...
