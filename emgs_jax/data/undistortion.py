"""Undistortion: a pinhole camera whose view lies within a distorted image, and the tables for cv2.remap."""

import math

import cv2
import numpy as np
from jaxtyping import Float

from emgs_jax.data.camera_models import Calibration, project, to_pycolmap, unproject
from emgs_jax.data.reading import Intrinsics, Size

MAX_VIEW_DEG = 120.0  # of the straight image's wider side; beyond, its border would only be stretched
NUM_BORDER = 9  # pixels of each side that bound the view, as in OpenCV's getOptimalNewCameraMatrix
MAX_BORDER = 2.0  # pixels by which the straight view may exceed the image, as it is fitted to these few
MIN_VIEW = 0.1  # of the image's area; less means wrong coefficients

Maps = tuple[np.ndarray, np.ndarray]  # for cv2.remap: column and row on disk of each straight pixel


def undistortion(camera: Calibration, size: Size, what: str = "dataset.intrinsics") -> tuple[Intrinsics, Maps, float]:
    """Intrinsics of a view within the distorted image, tables for cv2.remap, and the share of the image seen.

    ValueError if the coefficients fold the image, or leave less than MIN_VIEW of it.
    """
    lens, share = to_pycolmap(camera, size), 0.0
    scale = _scale(camera.intrinsics, _reach(lens, size), size)
    straight = scale * camera.intrinsics[0], scale * camera.intrinsics[1], (size[0] - 1) / 2, (size[1] - 1) / 2
    if math.isfinite(scale) and scale > 0:
        maps = _tables(lens, straight, size)
        share = _seen_share(maps, size)
    if share < MIN_VIEW:
        raise ValueError(
            f"{what}: the distortion {[*camera.distortion]} of the model {camera.model} leaves {100 * share:.0f} % of "
            f"the {size[0]}x{size[1]} image: check the order (OPENCV: k1, k2, p1, p2, k3), the signs and the model"
        )
    return straight, maps, share


def tables(camera: Calibration, straight: Intrinsics, size: Size) -> Maps:
    """Where each pixel of a pinhole camera with these intrinsics is in an image of `camera`, both of this size."""
    if not camera.is_pinhole:
        return _tables(to_pycolmap(camera, size), straight, size)
    fx, fy, cx, cy = straight
    own_fx, own_fy, own_cx, own_cy = camera.intrinsics
    columns, rows = np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64)
    u, v = np.meshgrid((columns - cx) / fx * own_fx + own_cx, (rows - cy) / fy * own_fy + own_cy)
    return u.astype(np.float32), v.astype(np.float32)


def _reach(lens: object, size: Size) -> Float[np.ndarray, " 4"]:
    """How far the whole image sees to its left, right, top and bottom, at depth 1."""
    columns, rows = (np.linspace(0, side - 1, NUM_BORDER) for side in size)
    left, right = (unproject(lens, np.column_stack([np.full(NUM_BORDER, u), rows]))[:, 0] for u in columns[[0, -1]])
    top, bottom = (unproject(lens, np.column_stack([columns, np.full(NUM_BORDER, v)]))[:, 1] for v in rows[[0, -1]])
    return np.nan_to_num(np.stack([-left, right, -top, bottom]), nan=np.inf).min(axis=1)


def _scale(intrinsics: Intrinsics, reach: Float[np.ndarray, " 4"], size: Size) -> float:
    """Factor of the focal lengths with which a centred view of `size` stays within `reach`."""
    half = np.array([size[0] - 1, size[0] - 1, size[1] - 1, size[1] - 1]) / 2
    focal = np.array(intrinsics)[[0, 0, 1, 1]]
    with np.errstate(divide="ignore"):
        return float((half / (focal * np.minimum(reach, math.tan(math.radians(MAX_VIEW_DEG / 2))))).max())


def _tables(lens: object, straight: Intrinsics, size: Size) -> Maps:
    """Column and row in the distorted image of each straight pixel; row by row, as images may be large."""
    fx, fy, cx, cy = straight
    maps = np.empty((2, size[1], size[0]), np.float32)
    rays = np.column_stack([(np.arange(size[0]) - cx) / fx, np.zeros(size[0])])
    for row in range(size[1]):
        rays[:, 1] = (row - cy) / fy
        maps[:, row] = project(lens, rays).T
    return maps[0], maps[1]


def _seen_share(maps: Maps, size: Size) -> float:
    """Share of the distorted image that the straight view shows; 0 if it exceeds or folds it."""
    x, y = maps
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return 0.0
    is_inside = min(x.min(), y.min()) >= -MAX_BORDER
    is_inside &= x.max() <= size[0] - 1 + MAX_BORDER and y.max() <= size[1] - 1 + MAX_BORDER
    is_folded = (np.diff(x, axis=1) <= 0).any() or (np.diff(y, axis=0) <= 0).any()
    if is_folded or not is_inside:
        return 0.0
    border = np.stack(maps, axis=-1)
    border = np.concatenate([border[0], border[1:, -1], border[-1, -2::-1], border[-2:0:-1, 0]])
    return cv2.contourArea(border) / (size[0] * size[1])
