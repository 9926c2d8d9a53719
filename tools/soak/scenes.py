"""A walk to and fro through the built-in room, and what may happen to a camera on it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.data.synthetic import Synthetic

SIZE, NUM_FRAMES = (64, 48), 40


@cache
def _room() -> Synthetic:
    return Synthetic(size=SIZE, num_frames=NUM_FRAMES)


@cache
def _frame(place: int) -> Frame:
    return _room()[place]


class ToAndFro:
    """So many frames of a camera that walks along the path of the room and back, over and over (a `Dataset`).

    Args:
        num_frames: of the walk.
        change: of a frame of it, for what may happen there.
        place: on the path, of a frame; to and fro if not given.
    """

    has_ground_truth = True

    def __init__(
        self,
        num_frames: int,
        change: Callable[[Frame], Frame] = lambda frame: frame,
        place: Callable[[int], int] | None = None,
    ) -> None:
        room = _room()
        self.name, self.sequence, self.size, self.classes = "to_and_fro", room.sequence, room.size, room.classes
        self.intrinsics, self.calibration = room.intrinsics, room.calibration
        self._num_frames, self._change, self._place = num_frames, change, place or to_and_fro

    def __len__(self) -> int:
        return self._num_frames

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self._num_frames:
            raise IndexError(index)
        frame = replace(_frame(self._place(index)), index=index, timestamp=float(index), name=f"frame {index}")
        return self._change(frame)

    def pose(self, index: int) -> np.ndarray:
        return _room().pose(self._place(index))

    def files(self, index: int) -> tuple[()]:
        return ()

    def fingerprint(self) -> str:
        return f"{self.name} {self._num_frames}"


def to_and_fro(index: int) -> int:
    """0, 1, …, 39, 38, …, 1, 0, 1, …"""
    lap = 2 * (NUM_FRAMES - 1)
    return min(index % lap, lap - index % lap)


def _gray(frame: Frame) -> Frame:
    return replace(frame, image=np.full_like(frame.image, 127))


def _between(first: int, past: int, change: Callable[[Frame], Frame]) -> Callable[[Frame], Frame]:
    return lambda frame: change(frame) if first <= frame.index < past else frame


def _blurred(frame: Frame) -> Frame:
    """As if the camera had turned by a fifth of the image while the shutter was open; the depth is smeared, too."""
    kernel = np.full((1, SIZE[0] // 5), 5.0 / SIZE[0])
    return replace(frame, image=cv2.filter2D(frame.image, -1, kernel), depth=cv2.filter2D(frame.depth, -1, kernel))


def _with_something_that_moves(frame: Frame) -> Frame:
    """A board of a quarter of the image, .7 m before the camera, which crosses it."""
    image, depth = frame.image.copy(), frame.depth.copy()
    start = 2 * frame.index % SIZE[0]
    image[12:36, start : start + 32], depth[12:36, start : start + 32] = (200, 30, 30), 0.7
    return replace(frame, image=image, depth=depth)


def _darker(frame: Frame) -> Frame:
    return replace(frame, image=(frame.image * 0.25).astype(np.uint8))


def _nothing(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image), depth=np.zeros_like(frame.depth))


# name -> the change of a frame from the fifth on, and the place on the path
SCENES: dict[str, tuple[Callable[[Frame], Frame], Callable[[int], int]]] = {
    "static": (lambda frame: frame, lambda index: 0),
    "textureless": (_gray, to_and_fro),
    "black frames": (_between(5, 8, _nothing), to_and_fro),
    "motion blur": (_between(5, 9, _blurred), to_and_fro),
    "moving object": (_with_something_that_moves, to_and_fro),
    "exposure jump": (_between(5, 10**9, _darker), to_and_fro),
    "zero overlap": (lambda frame: frame, lambda index: to_and_fro(index if index < 6 else index + 20)),
}
