"""7-Scenes: hand-held Kinect, SCENE/seq-XX/frame-%06d.{color.png|jpg, depth.png, pose.txt}."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from emgs_jax.data import reading
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.intrinsics import Given, find_lens, pictures_of
from emgs_jax.data.reading import Intrinsics, Number, Size
from emgs_jax.data.straightened import Straightened

LAYOUT = "root/SCENE/seq-XX/frame-000000.{color.png or color.jpg, depth.png, pose.txt}"
SOURCE = "7-Scenes, project page of Microsoft Research; unpack the inner seq-XX.zip as well"
RAW_SIZE = (640, 480)
# The release has no calibration: the depth camera's is KinectFusion's, the colour camera's and the transform kapture's.
DEPTH_INTRINSICS = (585.0, 585.0, 320.0, 240.0)
COLOR_INTRINSICS = (525.0, 525.0, 320.0, 240.0)
T_COLOR_DEPTH = np.array(
    [
        [0.99996518, 0.0026765127, -0.0079041012, -0.025558943],
        [-0.0027409311, 0.99996303, -0.0081504521, 0.00010109636],
        [0.0078819942, 0.0081718329, 0.99993555, 0.0020318322],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
FOOTPRINT_MARGIN = 1.2  # overlap of neighbouring pixels, so that slanted surfaces have no holes
NEAR = 0.05  # metres; the sensor measures nothing nearer


@dataclass(eq=False)
class SevenScenes(Straightened):
    """One sequence of 7-Scenes, "SCENE/seq-XX"."""

    stride: int = 10
    intrinsics: Given | None = None  # of the 640x480 colour images, as for `Images`; None: 525 if registered, else 585
    depth_scale: Number = 1000.0  # raw units per metre
    register_depth: bool = True  # warp depth into the colour camera and give its pose; else the depth camera's
    poses: str | None = None  # file with the true poses, in place of the release's, see `read_poses`

    name, layout, source = "seven_scenes", LAYOUT, SOURCE
    has_ground_truth = True

    def __post_init__(self) -> None:
        self._folder = self._find(self.sequence)
        images = find_images(self._folder)
        self._images = [images[i] for i in self._select(len(images), f"{self._folder} (layout {LAYOUT})")]
        self._times = [frame_number(path) for path in self._images]
        self._depths = [sibling(path, "depth.png") for path in self._images]
        self._depth_scale = reading.check_depth_scale(self.depth_scale)
        default = COLOR_INTRINSICS if self.register_depth else DEPTH_INTRINSICS
        given = default if self.intrinsics is None else self.intrinsics
        self._use(find_lens(given, pictures_of(self._images, RAW_SIZE)), RAW_SIZE)
        if self._lens.maps is not None and not self.register_depth:
            raise ValueError(
                "dataset.intrinsics with distortion is the colour camera's, but with dataset.register_depth=false the "
                "depth is another camera's, which it does not straighten: set dataset.register_depth=true"
            )
        self._poses_file = None if self.poses is None else Path(self.poses).expanduser()
        self._poses = None if self._poses_file is None else read_poses(self._poses_file, self._folder.name)

    def _depth(self, index: int) -> Float32[np.ndarray, "h w"]:
        if not self.register_depth:
            return super()._depth(index)
        raw = reading.read_depth(self._depths[index], self._depth_scale, RAW_SIZE)
        return register(raw, self.intrinsics, self.size)

    def pose(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        if self._poses is not None:
            T_world_color = self._poses.get(self._times[index])
            return T_world_color if self.register_depth or T_world_color is None else T_world_color @ T_COLOR_DEPTH
        path = sibling(self._images[index], "pose.txt")
        T_world_depth = reading.as_pose(reading.read_text(path), path) if path.exists() else None
        is_moved = self.register_depth and T_world_depth is not None
        return T_world_depth @ np.linalg.inv(T_COLOR_DEPTH) if is_moved else T_world_depth

    def files(self, index: int) -> list[Path]:
        return [*super().files(index), sibling(self._images[index], "pose.txt")]

    def _options(self) -> dict[str, Any]:
        return {"depth_scale": self._depth_scale, "register_depth": bool(self.register_depth)}

    def _fingerprinted(self) -> Iterable[Path]:
        return [*super()._fingerprinted(), *filter(None, [self._poses_file])]


def read_poses(path: Path, sequence: str) -> dict[float, Float[np.ndarray, "4 4"]]:
    """Read T_world_camera of the colour camera by frame number, from a list of pseudo ground truth.

    The release's poses are of KinectFusion with an uncalibrated depth camera: in redkitchen they turn 8 % more and move
    5 % less than the colour images, so a reconstruction from these cannot have their shape. Poses from structure from
    motion are published for all scenes (Brachmann, Humenberger, Rother and Sattler, "On the limits of pseudo ground
    truth in visual camera re-localisation", ICCV 2021), in lines "seq-XX/frame-000000.color.png qw qx qy qz tx ty tz
    focal", world -> colour camera; # begins a comment. Lines of other sequences are ignored.

    Raises:
        BadFrameError: a line of the sequence is damaged.
        ValueError: there is none of the sequence.
    """
    found = {}
    for row, line in enumerate(reading.read_text(path).splitlines(), start=1):
        name, *numbers = line.split() or ["#"]
        if name.startswith("#") or name.split("/")[-2:-1] != [sequence]:
            continue
        try:
            w, x, y, z, *translation = (float(number) for number in numbers[:7])
            if not np.isfinite([w, x, y, z, *translation]).all():  # lost tracking
                continue
            T_world_camera = np.linalg.inv(reading.rigid(translation, (x, y, z, w)))
        except ValueError as error:
            form = "seq-XX/frame-000000.color.png qw qx qy qz tx ty tz focal"
            raise BadFrameError(f"{path} line {row} is no pose of the form {form}: {reading.REMEDY}") from error
        reading.check_position(T_world_camera[:3, 3], path)
        found[frame_number(Path(name))] = T_world_camera
    if not found:
        raise ValueError(f"{path} has no line of {sequence}: give the list of its scene")
    return found


def find_images(folder: Path) -> list[Path]:
    """Find colour images in the order of their numbers; png is preferred to jpg."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; expected the layout {LAYOUT} ({SOURCE})")
    found: dict[float, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda p: p.suffix.lower() == ".png"):
        if re.fullmatch(r"frame-[0-9]+\.color\.(png|jpe?g)", path.name, re.IGNORECASE):
            found[frame_number(path)] = path
    return [found[number] for number in sorted(found)]


def frame_number(path: Path) -> float:
    return float(path.name.split(".")[0][len("frame-") :])


def sibling(path: Path, ending: str) -> Path:
    """frame-000012.depth.png for frame-000012.color.png."""
    return path.with_name(f"{path.name.split('.')[0]}.{ending}")


def register(depth: Float32[np.ndarray, "_ _"], intrinsics: Intrinsics, size: Size) -> Float32[np.ndarray, "_ _"]:
    """Warp the depth camera's 640x480 image into the colour camera at `size`; metres, 0 = none.

    Every source pixel is a square that covers the target pixels whose centres lie in it. The nearest surface wins, with
    its mean inverse depth, as the nearest square alone lies before a slanted surface.
    """
    points = backproject(depth, DEPTH_INTRINSICS)[depth > NEAR]
    # einsum, as a threaded matmul waits for its threads on a busy machine
    points = np.einsum("pj,ij->pi", points, T_COLOR_DEPTH[:3, :3]) + T_COLOR_DEPTH[:3, 3]
    points = points[points[:, 2] > NEAR]  # in the colour camera's axes
    (fx, fy, cx, cy), (w, h) = intrinsics, size
    u, v, z = fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy, points[:, 2]
    half_u, half_v = (0.5 * FOOTPRINT_MARGIN * f / g for f, g in zip((fx, fy), DEPTH_INTRINSICS[:2], strict=True))
    found = []
    for du in range(-int(half_u + 0.5), int(half_u + 0.5) + 1):
        for dv in range(-int(half_v + 0.5), int(half_v + 0.5) + 1):
            x, y = np.rint(u) + du, np.rint(v) + dv
            covered = (np.abs(x - u) <= half_u) & (np.abs(y - v) <= half_v)
            covered &= (x >= 0) & (x < w) & (y >= 0) & (y < h)
            found.append(((y[covered] * w + x[covered]).astype(np.intp), z[covered]))
    pixels, depths = (np.concatenate(column) for column in zip(*found, strict=True))
    nearest = np.full(h * w, np.inf)
    np.minimum.at(nearest, pixels, depths)
    is_front = depths <= (1.0 + reading.SAME_SURFACE) * nearest[pixels]
    pixels, inverse = pixels[is_front], 1.0 / depths[is_front]
    count, total = np.bincount(pixels, minlength=h * w), np.bincount(pixels, inverse, minlength=h * w)
    return np.where(count > 0, count / np.where(count > 0, total, 1.0), 0.0).astype(np.float32).reshape(h, w)
