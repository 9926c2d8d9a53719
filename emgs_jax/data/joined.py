"""Join data sets into one, in a camera that shows what all of theirs show."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.readable import ARRAYS
from emgs_jax.data.reading import Intrinsics, Size, check_index


class JoinedFrames(Dataset):
    """One data set after the other; without `has_truth` true poses, which are in several worlds, are left out.

    Args:
        repeated: rows that are left out, because another one is the same image.
    """

    def __init__(self, parts: Sequence[Dataset], has_truth: bool = True, repeated: Sequence[int] = ()) -> None:
        self.name, self.sequence = (joined_name(getattr(one, key) for one in parts) for key in ("name", "sequence"))
        self.size, self.intrinsics = common_camera([(one.size, one.intrinsics) for one in parts])
        self.classes = parts[0].classes if len({tuple(one.classes) for one in parts}) == 1 else ()
        self.has_ground_truth = has_truth and all(one.has_ground_truth for one in parts)
        self._parts, self._has_truth, self._repeated = parts, has_truth, sorted(repeated)
        left_out = {*repeated}
        every = [(one, row) for one in parts for row in range(len(one))]
        self._rows = [one for row, one in enumerate(every) if row not in left_out]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Frame:
        check_index(index, len(self))
        part, row = self._rows[index]
        frame = replace(part[row], index=index)
        if (tuple(part.size), tuple(part.intrinsics)) != (self.size, self.intrinsics):
            frame = resampled(frame, part.intrinsics, self.intrinsics, self.size)
        frame = frame if self.classes else replace(frame, labels=None)
        return frame if self._has_truth else replace(frame, depth=None, T_world_camera=None)

    def pose(self, index: int) -> np.ndarray | None:
        part, row = self._rows[index]
        return part.pose(row) if self._has_truth else None

    def files(self, index: int) -> Sequence[Path]:
        part, row = self._rows[index]
        return part.files(row)

    def fingerprint(self) -> str:
        known = [one.fingerprint() for one in self._parts], self._has_truth, *filter(None, [self._repeated])
        return hashlib.sha256(repr(known).encode()).hexdigest()


def joined_name(names: Iterable[object]) -> str:
    return "+".join(dict.fromkeys(map(str, names)))


def common_camera(cameras: Sequence[tuple[Size, Intrinsics]]) -> tuple[Size, Intrinsics]:
    """The camera of the first one's focal lengths that shows all that they have in common; ValueError if nothing."""
    (first, (fx, fy, *_)), sides = cameras[0], []
    for size, (*focal, cx, cy) in cameras:
        sides.append([((edge - 0.5 - c) / f) for c, f, n in zip((cx, cy), focal, size, strict=True) for edge in (0, n)])
    (left, _, top, _), (_, right, _, bottom) = np.max(sides, axis=0), np.min(sides, axis=0)
    width, height = (int(np.floor(span + 1e-3)) for span in ((right - left) * fx, (bottom - top) * fy))
    if min(width, height) < 1:
        raise ValueError("the cameras of these runs show nothing in common: merge runs of cameras that look alike")
    found = float(fx), float(fy), float(-left * fx - 0.5), float(-top * fy - 0.5)
    is_first = (width, height) == tuple(first) and np.allclose(found, cameras[0][1], atol=1e-3)
    return (width, height), tuple(map(float, cameras[0][1])) if is_first else found  # to the last digit


def resampled(frame: Frame, of: Intrinsics, to: Intrinsics, size: Size) -> Frame:
    """Resample a frame for another camera at the same place, colours bilinearly, all else by the nearest pixel."""
    x, y = (
        ((np.arange(count) - to[axis + 2]) / to[axis] * of[axis] + of[axis + 2]).astype(np.float32)
        for axis, count in enumerate(size)
    )
    at = np.meshgrid(x, y)

    def drawn(name: str) -> np.ndarray:
        values = getattr(frame, name)
        kind = cv2.INTER_LINEAR if name == "image" else cv2.INTER_NEAREST
        plain = values.astype(np.uint8) if values.dtype == bool else values
        return cv2.remap(plain, *at, kind, borderMode=cv2.BORDER_REPLICATE).astype(values.dtype)

    return replace(frame, **{name: drawn(name) for name in ARRAYS if getattr(frame, name) is not None})
