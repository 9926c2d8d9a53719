"""Replica in NICE-SLAM's layout: cam_params.json, SCENE/traj.txt, SCENE/results/{frame%06d.jpg, depth%06d.png}."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from emgs_jax.data import reading
from emgs_jax.data.calibration_files import Calibration
from emgs_jax.data.file_names import natural_key
from emgs_jax.data.intrinsics import Given, find_lens, pictures_of, to_lens
from emgs_jax.data.reading import Intrinsics, Number, Size
from emgs_jax.data.straightened import Straightened

LAYOUT = "root/{cam_params.json, SCENE/{traj.txt, results/{frame000000.jpg, depth000000.png}}}"
SOURCE = "Replica as rendered for iMAP and NICE-SLAM, see the NICE-SLAM project page"


@dataclass(eq=False)
class Replica(Straightened):
    """One rendered sequence of Replica, such as "office0", below root, which has cam_params.json."""

    stride: int = 10
    size: Sequence[int] = (320, 180)
    intrinsics: Given | None = None  # of the images on disk, as for `Images`; None: those of cam_params.json
    depth_scale: Number | None = None  # raw units per metre; None: that of cam_params.json

    name, layout, source = "replica", LAYOUT, SOURCE
    has_ground_truth = True

    def __post_init__(self) -> None:
        self._folder = self._find(self.sequence)
        images = find_images(self._folder / "results")
        chosen = self._select(len(images), f"{self._folder / 'results'} (layout {LAYOUT})")
        self._images = [images[i] for i in chosen]
        self._times = [number_of(path) for path in self._images]
        self._depths = [path.with_name(f"depth{path.stem[len('frame') :]}.png") for path in self._images]
        self._files = (self._folder / "traj.txt",)
        self._poses = read_rows(self._files[0], self._images)
        path = Path(str(self.root)).expanduser() / "cam_params.json"
        raw_size, calibration, scale = read_calibration(path)
        if self.intrinsics is None:
            lens = to_lens(Calibration(calibration, (), raw_size), raw_size, str(path), {"source": path.name})
        else:
            lens = find_lens(self.intrinsics, pictures_of(self._images, raw_size))
        self._use(lens, raw_size)
        self._depth_scale = reading.check_depth_scale(scale if self.depth_scale is None else self.depth_scale)

    def pose(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        return reading.as_pose(self._poses[index], f"{self._files[0]}, row {self._times[index]} (from 0),")

    def _options(self) -> dict[str, Any]:
        return {"depth_scale": self._depth_scale}


def find_images(folder: Path) -> list[Path]:
    """Find frame%06d.jpg (or .png), in the order of their numbers."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} does not exist; expected the layout {LAYOUT} ({SOURCE})")
    found = [p for p in folder.iterdir() if re.fullmatch(r"frame[0-9]+\.(jpe?g|png)", p.name, re.IGNORECASE)]
    return sorted(found, key=natural_key)


def number_of(path: Path) -> int:
    return int(path.stem[len("frame") :])


def read_rows(path: Path, images: list[Path]) -> list[str]:
    """Read the row of traj.txt, as text, of every image: frame000012 belongs to row 12, from 0."""
    text = reading.layout_text(path, LAYOUT).rstrip()
    rows, last = [row for row in text.splitlines() if not row.lstrip().startswith("#")], max(map(number_of, images))
    if not all(map(str.strip, rows)) and last < sum(map(bool, map(str.strip, rows))):
        raise ValueError(
            f"{path} has blank lines among its poses, so it is unclear which images the poses after them belong to: "
            "remove the lines, or write 16 times nan for an image without a pose"
        )
    if last >= len(rows):
        raise ValueError(f"{path} has {len(rows)} poses, but there is an image number {last}: fetch traj.txt again")
    return [rows[number_of(p)] for p in images]


def read_calibration(path: Path) -> tuple[Size, Intrinsics, float]:
    """Read image size, intrinsics and depth scale from cam_params.json."""
    try:
        camera = json.loads(reading.layout_text(path, LAYOUT))["camera"]
        size = int(camera["w"]), int(camera["h"])
        fx, fy, cx, cy, scale = (float(camera[key]) for key in ("fx", "fy", "cx", "cy", "scale"))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f'{path} must hold {{"camera": {{w, h, fx, fy, cx, cy, scale}}}}: {error!r}') from error
    scale = reading.check_depth_scale(scale, f"{path}: scale")
    return size, reading.check_intrinsics((fx, fy, cx, cy), size, str(path)), scale
