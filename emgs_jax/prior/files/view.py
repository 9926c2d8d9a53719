"""A frame's prediction in a file, and its points at the frame's pixels."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.reading import Size
from emgs_jax.prior.network.resize import at_pixels, on_grid_of

Intrinsics = tuple[float, float, float, float]
MAX_ASPECT_ERROR = 0.05  # of what shows a whole image: networks round a side to whole patches
LEAST_DEPTH = 1e-6  # below: no value
ROOM = 0.05, 100.0  # m, median depth of a view that is metric


@dataclass(frozen=True)
class View:
    """Prediction of one frame on its file's own grid (gh, gw)."""

    source: str
    geometry: np.ndarray  # depths (gh, gw) or points (gh, gw, 3) of the camera; 0 or not finite = no value
    confidence: np.ndarray | None = None  # (gh, gw), at least 1; None: 1
    intrinsics: Intrinsics | None = None  # fx, fy, cx, cy of the grid; None: those of the frames

    @property
    def grid(self) -> Size:
        """(width, height)."""
        return self.geometry.shape[1], self.geometry.shape[0]


class Camera(NamedTuple):
    """The camera of the frames: (width, height) and fx, fy, cx, cy there."""

    size: Size
    intrinsics: Sequence[float]

    @property
    def aspect(self) -> float:
        """Aspect of the image as it was taken, with square pixels."""
        (width, height), (fx, fy, *_) = self.size, self.intrinsics
        return width * fy / (height * fx)


class Part(NamedTuple):
    """Part of the image that a grid shows: the image's size in the grid's pixels, and the grid's corner in it."""

    scaled: tuple[float, float]
    corner: tuple[float, float]


Place = Callable[[Camera, View], Part]


@dataclass(frozen=True)
class Predictions:
    """Predictions that a folder holds."""

    layout: str
    names: list[str]  # of the views: stems of their images' names, or their own
    poses: np.ndarray  # T_world_camera (n, 4, 4), NaN where unknown
    pose_source: str  # file and key of the poses, for messages
    read: Callable[[int], View]
    files: list[Path]
    is_metric: bool
    place: Place  # the part of the image that grids show
    may_lack: bool = False  # frames without a view are allowed
    is_straight: bool = False  # they are of undistorted images, with their own calibration, not of those on disk
    unread: tuple[str, ...] = ()  # arrays of the first file that are not used


def check_metres(depth: float, source: str, remedies: str) -> None:
    """Raise ValueError, with `remedies`, if a view's median depth is none in metres."""
    if not ROOM[0] <= depth <= ROOM[1]:
        raise ValueError(f"{source} has a median of {depth:.4g}, which is no depth in metres: {remedies}")


def whole_image(camera: Camera, view: View) -> Part:
    """The part of a grid that shows the whole image at any size; ValueError if its aspect differs."""
    width, height = view.grid
    if abs(math.log(width / height / camera.aspect)) > MAX_ASPECT_ERROR:
        raise ValueError(
            f"{view.source} is {width}x{height} and the image {camera.aspect:.3f} times as wide as high: a file must "
            "show the whole image; where it was cropped, write it onto the whole image with 0 where nothing is known"
        )
    return Part((width, height), (0, 0))


def by_rays(camera: Camera, view: View) -> Part:
    """The part of a sensor with its own calibration at the camera's place: pixels are matched by rays."""
    assert view.intrinsics is not None
    (width, height), (fx, fy, cx, cy) = camera.size, view.intrinsics
    x, y = fx / camera.intrinsics[0], fy / camera.intrinsics[1]
    corner = (camera.intrinsics[2] + 0.5) * x - 0.5 - cx, (camera.intrinsics[3] + 0.5) * y - 0.5 - cy
    return Part((width * x, height * y), corner)


def at_frame(
    view: View, camera: Camera, place: Place, max_depth_step: float, stored: Float[np.ndarray, "h w 2"] | None = None
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Resample a view at the frame's pixels, see `resize.at_pixels`; points lie where its own calibration has them.

    Frames without the distortion of their images, of which the view is, have `stored` (`Dataset.stored_pixels`). There
    depths lie on the frame's rays: no calibration of a pinhole says where the distorted image has them.
    """
    scaled, corner = place(camera, view)
    mask = usable(view.geometry)
    confidence = np.ones(mask.shape) if view.confidence is None else view.confidence
    geometry = np.where(mask if view.geometry.ndim == 2 else mask[..., None], view.geometry, 0)
    intrinsics = view.intrinsics or grid_intrinsics(camera, Part(scaled, corner))
    points = backproject(geometry, intrinsics) if geometry.ndim == 2 else geometry
    on_grid = points.astype(np.float32), np.where(mask, confidence, 1).astype(np.float32), mask
    if stored is None:
        return at_pixels(*on_grid, on_grid_of(camera.size, scaled, corner), max_depth_step)
    columns, rows = np.moveaxis(stored * scaled - 0.5 - np.asarray(corner), -1, 0)
    points, confidence, mask = at_pixels(*on_grid, (columns, rows), max_depth_step)
    if geometry.ndim == 2:
        points = backproject(points[..., 2], camera.intrinsics).astype(np.float32)
    return points, confidence, mask


def usable(geometry: Float[np.ndarray, "gh gw *c"]) -> Bool[np.ndarray, "gh gw"]:
    """Mark the pixels with a finite depth or point, at least LEAST_DEPTH before the camera."""
    depth = geometry if geometry.ndim == 2 else geometry[..., 2]
    with np.errstate(invalid="ignore"):
        is_before = depth > LEAST_DEPTH
    return is_before & (np.isfinite(geometry) if geometry.ndim == 2 else np.isfinite(geometry).all(-1))


def grid_intrinsics(camera: Camera, part: Part) -> Intrinsics:
    """fx, fy, cx, cy of a grid with the frames' rays."""
    (x, y), (left, top) = (length / size for length, size in zip(part.scaled, camera.size, strict=True)), part.corner
    fx, fy, cx, cy = camera.intrinsics
    return fx * x, fy * y, (cx + 0.5) * x - 0.5 - left, (cy + 0.5) * y - 0.5 - top
