"""TUM RGB-D and other data in its layout: rgb.txt, depth.txt, groundtruth.txt, associated by timestamp."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int32

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.file_names import find_image, is_file
from emgs_jax.data.intrinsics import ALTERNATIVES, Given, find_lens, pictures_of
from emgs_jax.data.labels import LabelFolder, as_unknown
from emgs_jax.data.reading import Intrinsics, Number
from emgs_jax.data.straightened import Straightened
from emgs_jax.data.timestamps import check_tolerance, in_seconds, matched_rows
from emgs_jax.data.tones import tones_of

LAYOUT = "root/SEQUENCE/{rgb.txt, depth.txt, groundtruth.txt, rgb/, depth/}"
RAW_SIZE = (640, 480)
Calibrations = Mapping[str, tuple[Intrinsics, tuple[float, ...] | None]]  # by a part of the sequence's name
REMEDY = "correct the line or take it out (its image then has no true pose), or set on_bad_frame=skip"
# Calibration by the benchmark (digits of ORB-SLAM2); fr3 comes undistorted. Distortion is k1, k2, p1, p2, k3.
CALIBRATIONS: Calibrations = {
    "freiburg1": (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "freiburg2": (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), None),
}


@dataclass(eq=False)
class TumLayout(Straightened):
    """One sequence in TUM's layout, images in order of time; ground truth needs depth.txt and groundtruth.txt.

    A colour image without depth near in time has depth 0 everywhere; without a pose near, or with inf or nan, it has
    none. It is an error if no image has a depth, or none a pose.
    """

    stride: int = 10
    intrinsics: Given | None = None  # of the images on disk, as for `Images`; None: the benchmark's calibration
    depth_scale: Number = 5000.0  # raw units per metre
    max_time_difference: Number = 0.02  # seconds between a colour image and its depth image or pose

    layout = LAYOUT
    calibrations: ClassVar[Calibrations]
    distortion = None

    def __post_init__(self) -> None:
        self._folder = self._find(self.sequence)
        self._lists = {name: self._folder / f"{name}.txt" for name in ("rgb", "depth", "groundtruth")}
        self._files = (*self._lists.values(),)
        times, names, lines = read_list(self._lists["rgb"], 2)
        chosen = self._select(len(times), f"{self._lists['rgb']} (layout {LAYOUT})")
        self._times, self._images = times[chosen], [find_image(self._folder, names[i][0]) for i in chosen]
        self._depth_scale = reading.check_depth_scale(self.depth_scale)
        tolerance = check_tolerance(self.max_time_difference)
        depths = nearest_lines(self._lists["depth"], 2, self._times, tolerance, "depth")
        self._depths = depths and [found and find_image(self._folder, found[0][0]) for found in depths]
        self._poses = nearest_lines(self._lists["groundtruth"], 8, self._times, tolerance, "pose")
        self.has_ground_truth = self._depths is not None and self._poses is not None
        is_own = self.intrinsics is None
        raw_size = RAW_SIZE if is_own else reading.first_size(self._images, self._folder)
        self._tones = tones_of(self._images)
        given = find_calibration(self.sequence, self.intrinsics, self.distortion, self.calibrations)
        lens = find_lens(given, pictures_of(self._images, raw_size, self._tones))
        self._use(lens, raw_size, back_note(self._lists["rgb"], times, lines), reading.transparency_note(self._images))

    def pose(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        if self._poses is None or self._poses[index] is None:
            return None
        words, line = self._poses[index]
        return as_transform(words, f"{self._lists['groundtruth']}, line {line}:")

    def _options(self) -> dict[str, Any]:
        return {
            "undistorted": self._lens.maps is not None,
            "depth_scale": self._depth_scale,
            "depths": [p and p.name for p in self._depths or ()],
            "poses": self._poses and [found and found[0] for found in self._poses],
        }


@dataclass(eq=False)
class Tum(TumLayout):
    """TUM RGB-D, where freiburg1, 2 and 3 in the sequence's name choose the calibration, and what has its layout."""

    distortion: Sequence[Number] | None = None  # k1, k2, p1, p2, k3, beside four numbers of `intrinsics`
    labels: str | None = None  # folder in the sequence with class images, see `LabelFolder`
    classes: str = "classes.txt"  # file in the sequence that names the ids; then the names themselves
    unknown: Sequence[int] | None = None  # ids that mean no class, see `LabelFolder`

    name = "tum"
    source = "TUM RGB-D benchmark, project page of the Computer Vision Group of TU Munich"
    calibrations = CALIBRATIONS

    def __post_init__(self) -> None:
        super().__post_init__()
        self._labels = None
        if self.labels is not None:
            ids = as_unknown(self.unknown, "dataset.unknown")
            self._labels = LabelFolder(self._folder / self.labels, self._folder / self.classes, ids, "dataset.unknown")
        self.classes = () if self._labels is None else self._labels.names

    def _labels_of(self, index: int) -> Int32[np.ndarray, "h w"] | None:
        if self._labels is None:
            return None
        ids = self._labels.read(self._images[index], self._raw_size)
        # The lens fills the border with 0, which must not become a class.
        straight = self._lens.straighten_depth((ids + 1).astype(np.float32)).astype(np.int32) - 1
        return reading.resize_nearest(straight, self.size)

    def files(self, index: int) -> list[Path]:
        labels = [] if self._labels is None else [self._labels.path(self._images[index]), self._labels.classes]
        return [*super().files(index), *labels]

    def _options(self) -> dict[str, Any]:
        return super()._options() | ({} if self._labels is None else {"classes": self.classes})


def read_list(path: Path, columns: int) -> tuple[Float[np.ndarray, " n"], list[list[str]], list[int]]:
    """Read ascending seconds, the words after each, and its line number; '#' begins a comment.

    With two columns the second is a file name, which may have spaces or quotes.
    """
    times, words, numbers = [], [], []
    for number, line in enumerate(reading.layout_text(path, LAYOUT).splitlines(), 1):
        row = line.replace(",", " ").split()
        if not row or row[0].startswith("#"):
            continue
        try:
            time = float(row[0])
        except ValueError:
            time = math.nan
        if len(row) < columns or not math.isfinite(time):
            raise ValueError(f"{path}, line {number}: expected a timestamp and {columns - 1} more, got {line[:80]!r}")
        times.append(time)
        words.append([_file_name(line, row[1], path.parent)] if columns == 2 else row[1:columns])
        numbers.append(number)
    order = np.argsort(times, kind="stable")
    return in_seconds(np.array(times, np.float64)[order]), [words[i] for i in order], [numbers[i] for i in order]


def nearest_lines(
    path: Path, columns: int, times: Float[np.ndarray, " n"], tolerance: float, what: str
) -> list[tuple[list[str], int] | None] | None:
    """Words and line number of a list nearest to each time, None if none is near; None without the list."""
    if not path.exists():
        return None
    known, words, lines = read_list(path, columns)
    rows = matched_rows(times, known, tolerance, (what, path))
    return [None if row < 0 else (words[row], lines[row]) for row in rows]


def back_note(path: Path, times: Float[np.ndarray, " n"], lines: Sequence[int]) -> str | None:
    """Describe where times go back from one line to the next, as after a clock was set; None if they do not."""
    written = np.argsort(lines)
    steps = np.diff(times[written])
    if not len(steps) or steps.min() >= 0:
        return None
    line = np.asarray(lines)[written][steps.argmin() + 1]
    return (
        f"{path.name}, line {line}: time goes back by {-steps.min():.3f} s, and all lines are taken in order of time: "
        "where a clock was set back, add what it lost to the times from there on"
    )


def _file_name(line: str, first_word: str, folder: Path) -> str:
    """The rest of the line behind the time if it names a file, else its first word: more columns may follow."""
    whole = re.split(r"[,\s]+", line.strip(), maxsplit=1)[1].strip(" \t,\"'")
    return whole if is_file(find_image(folder, whole)) else first_word.strip("\"'")


def as_transform(words: list[str], where: object) -> Float[np.ndarray, "4 4"] | None:
    """T_world_camera from tx ty tz qx qy qz qw; None if inf or nan (lost tracking). Raises as `reading.as_pose`."""
    try:
        values = np.array([float(word) for word in words], np.float64)
    except ValueError as error:
        raise BadFrameError(f"{where} {' '.join(words)!r} must be tx ty tz qx qy qz qw: {REMEDY}") from error
    if not np.isfinite(values).all():
        return None
    try:
        pose = reading.rigid(values[:3], values[3:])
    except ValueError as error:
        raise BadFrameError(f"{where} {' '.join(words)!r} is no pose, as {error}: {REMEDY}") from error
    reading.check_position(values[:3], where)
    return pose


def find_calibration(
    sequence: str, intrinsics: Given | None, distortion: Sequence[Number] | None, calibrations: Calibrations
) -> Given:
    """The calibration of the images on disk: the given one, else the benchmark's by the sequence's name."""
    if intrinsics is None:
        if distortion is not None:
            raise ValueError("dataset.distortion needs the dataset.intrinsics that it was calibrated with")
        for key, (calibration, bent) in calibrations.items():
            if key in sequence.lower():
                return (*calibration, *(bent or ()))
        raise ValueError(f"{sequence} names no calibration ({', '.join(calibrations)}): give {ALTERNATIVES}")
    if distortion is None:
        return intrinsics
    bent = tuple(float(v) for v in distortion)
    if len(bent) != 5 or not np.isfinite(bent).all():
        raise ValueError(f"dataset.distortion must be [k1, k2, p1, p2, k3], got {list(distortion)}")
    if isinstance(intrinsics, str) or len(intrinsics) != 4:
        raise ValueError("dataset.distortion goes with dataset.intrinsics=[fx,fy,cx,cy] only: put it behind them")
    return (*intrinsics, *bent)
