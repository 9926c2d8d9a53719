"""KITTI odometry: rectified images from a car, and the motion of its left grey camera; no depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.calibration_files import Calibration
from emgs_jax.data.file_names import IMAGE_SUFFIXES, natural_key
from emgs_jax.data.posed_images import Pose, PosedImages, Solved

LAYOUT = "root/{sequences/00/{image_2/ or image_0/, calib.txt, times.txt}, poses/00.txt}"
SOURCE = "KITTI odometry benchmark: colour images, calibration files and ground truth poses, project page at KIT"


@dataclass(eq=False)
class Kitti(PosedImages):
    """One camera of one sequence below root, which has sequences/ and poses/; 11 to 21 have no poses.

    The world is the left grey camera at the first image.
    """

    sequence: str | int | None = None  # "00"; 7 means 07
    size: Sequence[int] = (480, 144)
    camera: int | None = None  # 0 and 1 are grey, 2 and 3 in colour, left and right; None: 2, or 0 without it

    name, layout, source = "kitti", LAYOUT, SOURCE

    def __post_init__(self) -> None:
        self.sequence = None if self.sequence is None else str(self.sequence).zfill(2)
        folder = self._find(self.sequence and f"sequences/{self.sequence}")
        truth = folder.parents[1] / "poses" / f"{self.sequence}.txt"
        camera = self.camera
        if camera is None:  # the benchmark's downloads are grey or in colour
            camera = next((one for one in (2, 0) if (folder / f"image_{one}").is_dir()), 2)
        self._take(folder, read_kitti(folder, truth, camera))


def read_kitti(folder: Path, truth: Path, camera: int) -> Solved:
    """Read a camera's images and its poses, from those of camera 0 in `truth` or in poses.txt of `folder`, if any.

    Raises:
        FileNotFoundError: a file of the layout is missing.
        ValueError: it is damaged, or a list has not a row for every image.
    """
    images = folder / f"image_{camera}"
    if not images.is_dir():
        raise FileNotFoundError(f"{images} is no folder; expected the layout {LAYOUT} ({SOURCE})")
    found = (path for path in images.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    paths = sorted(found, key=natural_key)
    calibration, clock = folder / "calib.txt", folder / "times.txt"
    intrinsics, T_first_camera = read_projection(calibration, f"P{camera}")
    truth = next((path for path in (truth, folder / "poses.txt") if path.is_file()), None)
    poses: list[Pose | None] = [None] * len(paths)
    if truth is not None:
        rows = read_rows(truth, len(paths))
        poses = [pose_of(row, f"{truth}, line {line}:", T_first_camera) for line, row in enumerate(rows, 1)]
    clocked = enumerate(read_rows(clock, len(paths)), 1)
    times = [float(_numbers(row, 1, f"{clock}, line {line}:")[0]) for line, row in clocked]
    files = calibration, clock, *([] if truth is None else [truth])
    return Solved(paths, poses, [intrinsics] * len(paths), truth or calibration, files, times)


def read_rows(path: Path, count: int) -> list[str]:
    rows = reading.layout_text(path, f"{LAYOUT} ({SOURCE})").rstrip().splitlines()
    if len(rows) != count:
        raise ValueError(f"{path} has {len(rows)} lines for {count} images: fetch the sequence and this file again")
    return rows


def read_projection(path: Path, key: str) -> tuple[Calibration, Float[np.ndarray, "4 4"]]:
    """The camera with projection K [I | t] in calib.txt, and its pose T_first_camera relative to the left grey one."""
    text = reading.layout_text(path, f"{LAYOUT} ({SOURCE})")
    lines = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    if key not in lines:
        raise ValueError(f"{path} has no {key}: fetch the calibration files of the odometry benchmark")
    P = _numbers(lines[key], 12, f"{path}: {key}").reshape(3, 4)
    K, pose = P[:, :3], np.eye(4)
    if K[0, 1] or K[1, 0] or K[2].tolist() != [0, 0, 1] or not min(K[0, 0], K[1, 1]) > 0:
        raise ValueError(f"{path}: {key} must be that of a rectified camera, fx 0 cx, 0 fy cy, 0 0 1: fetch it again")
    pose[:3, 3] = -np.linalg.solve(K, P[:, 3])
    return Calibration((K[0, 0], K[1, 1], K[0, 2], K[1, 2])), pose


def pose_of(row: str, where: str, T_first_camera: Pose) -> Pose | None:
    """T_world_camera from twelve numbers, the upper part of camera 0's pose; None if inf or nan."""
    if len(row.split()) != 12:
        raise BadFrameError(f"{where} {row[:80]!r} must be 12 numbers, the upper part of a pose: fetch the file again")
    pose = reading.as_pose(f"{row} 0 0 0 1", where, may_be_far=True)
    return None if pose is None else pose @ T_first_camera


def _numbers(text: str, count: int, where: str) -> Float[np.ndarray, " n"]:
    try:
        values = np.array([float(word) for word in text.split()], np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{where} must be {count} finite numbers, got {text.strip()[:80]!r}: fetch it again")
    return values
