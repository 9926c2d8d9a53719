"""Resample between a data set's frames and a network's grid, by MapAnything's resize-and-crop rule.

Sizes are (width, height), pixel centres are integers. The frame is scaled to cover the grid, rounded down to whole
pixels and cropped at its centre. As upstream, with which the network was trained, intrinsics follow the scale, pixels
the rounded size: at the sides of some grids a ray is up to half a pixel off (.41 at 1200×680, a third at 640×480).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from PIL import Image

Size = tuple[int, int]

LONGER, SHORTER = 518, (168, 252, 294, 336, 392, 518)  # sides of the grids; upstream's `fixed_mapping`


@dataclass(frozen=True)
class Resize:
    """Scale frames of one size, then crop them to a network's grid."""

    frame: Size
    grid: Size
    scaled: Size  # of the frame before the crop
    corner: tuple[int, int]  # (left, top) of the crop in the scaled frame
    scale: float  # of the intrinsics


def choose_grid(frame: Size) -> Size:
    """The grid whose aspect is nearest to the frames'; all but the widest also exist upright."""
    wide = [(LONGER, height) for height in SHORTER]
    grids = [*wide, *((height, width) for width, height in wide[1:])]
    return min(grids, key=lambda grid: abs(round(grid[0] / grid[1], 3) - frame[0] / frame[1]))  # as upstream rounds


def plan_resize(frame: Size, grid: Size) -> Resize:
    """Scale and crop `frame` to `grid`; the identity if both are equal."""
    scale = max(grid[0] / frame[0], grid[1] / frame[1]) + 1e-8  # upstream's guard against rounding below the grid
    scaled = math.floor(frame[0] * scale), math.floor(frame[1] * scale)
    corner = round((scaled[0] - grid[0]) / 2), round((scaled[1] - grid[1]) / 2)
    return Resize((frame[0], frame[1]), (grid[0], grid[1]), scaled, corner, scale)


def resize_intrinsics(intrinsics: Sequence[float], resize: Resize) -> Float32[np.ndarray, "3 3"]:
    """Camera matrix on the grid from fx, fy, cx, cy of the frame; float32, as the network refuses float64."""
    fx, fy, *center = intrinsics
    cx, cy = (
        (c + 0.5) * resize.scale - 0.5 * (size * resize.scale - scaled) - 0.5 - corner
        for c, size, scaled, corner in zip(center, resize.frame, resize.scaled, resize.corner, strict=True)
    )
    return np.array([[fx * resize.scale, 0, cx], [0, fy * resize.scale, cy], [0, 0, 1]], np.float32)


def resize_image(image: UInt8[np.ndarray, "h w 3"], resize: Resize) -> UInt8[np.ndarray, "_ _ 3"]:
    """Resize a frame (Lanczos if it shrinks, else bicubic) and crop it to the grid."""
    method = Image.Resampling.LANCZOS if resize.scale < 1 else Image.Resampling.BICUBIC
    (left, top), (width, height) = resize.corner, resize.grid
    return np.asarray(Image.fromarray(image).resize(resize.scaled, method))[top : top + height, left : left + width]


def on_grid_of(
    frame: Size, scaled: Sequence[float], corner: Sequence[float]
) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " h"]]:
    """Fractional grid column of every column of the frame, grid row of every row; beyond the grid where cropped."""
    columns, rows = (
        (np.arange(size) + 0.5) * (length / size) - 0.5 - start
        for size, length, start in zip(frame, scaled, corner, strict=True)
    )
    return columns, rows


def at_pixels(
    points: Float32[np.ndarray, "gh gw 3"],
    confidence: Float32[np.ndarray, "gh gw"],
    mask: Bool[np.ndarray, "gh gw"],
    pixels: tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]],
    max_depth_step: float,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Resample points (camera frame), confidence and mask of a grid at the grid columns and rows `pixels`.

    These are of the frame's columns (w,) and rows (h,), or each of its pixels (h, w).

    Mask and confidence are those of the nearest grid pixel; beyond the grid the mask is off. The point is interpolated
    (ray and inverse depth, which are linear on a plane) where the four pixels around are valid and differ in depth by
    at most `max_depth_step`, else it is the nearest. Where the mask is off, the point is 0 and the confidence 1.
    """
    columns, rows = pixels[0], pixels[1] if pixels[1].ndim == 2 else pixels[1][:, None]
    height, width = mask.shape
    column, row = np.floor(columns + 0.5).astype(int), np.floor(rows + 0.5).astype(int)
    is_inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    nearest = row.clip(0, height - 1), column.clip(0, width - 1)
    on = is_inside & mask[nearest]
    chosen = points[nearest]
    if (columns % 1).any() or (rows % 1).any():  # at whole pixels nothing lies between
        between, is_between = _interpolate(points, mask, columns, rows, max_depth_step)
        chosen = np.where((on & is_between)[..., None], between, chosen)
    return (
        np.where(on[..., None], chosen, 0).astype(np.float32),
        np.where(on, confidence[nearest], 1).astype(np.float32),
        on,
    )


def _interpolate(
    points: np.ndarray, mask: np.ndarray, columns: np.ndarray, rows: np.ndarray, max_depth_step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points (h, w, 3) between the grid's pixels, and where they are defined (h, w), which whole pixels are not."""
    height, width = mask.shape
    left, top = np.floor(columns).astype(int).clip(0, width - 2), np.floor(rows).astype(int).clip(0, height - 2)
    x, y = columns - left, rows - top
    depth = np.where(mask, points[..., 2], 1)
    coordinates = np.stack([points[..., 0] / depth, points[..., 1] / depth, 1 / depth], axis=-1)
    mixed, low, high, is_whole = 0.0, np.inf, -np.inf, True
    for down, right, weight in ((0, 0, (1 - y) * (1 - x)), (0, 1, (1 - y) * x), (1, 0, y * (1 - x)), (1, 1, y * x)):
        corner = top + down, left + right
        mixed = mixed + weight[..., None] * coordinates[corner]
        low, high = np.minimum(low, depth[corner]), np.maximum(high, depth[corner])
        is_whole = is_whole & mask[corner]
    is_within = (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1) & ((x % 1 != 0) | (y % 1 != 0))
    is_defined = is_whole & is_within & (high - low <= max_depth_step * low)
    inverse = np.where(is_defined, mixed[..., 2], 1)
    return np.stack([mixed[..., 0] / inverse, mixed[..., 1] / inverse, 1 / inverse], axis=-1), is_defined
