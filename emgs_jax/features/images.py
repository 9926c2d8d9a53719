"""Prepare an image for a vision transformer: whole patches, normalised colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class ImageConfig:
    """Preprocessing of images for the network: resizing and normalization."""

    # pixels to which the longer side is resized, a multiple of the patch
    long_side: int = number(640, low=1, high=65536)
    mean: Sequence[float] = (0.485, 0.456, 0.406)  # of RGB in [0, 1], subtracted
    std: Sequence[float] = (0.229, 0.224, 0.225)


def grid_size(size: tuple[int, int], patch: int, long_side: int) -> tuple[int, int]:
    """(columns, rows) of patches for an image of `size` (width, height), nearest to its aspect ratio."""
    if long_side < patch or long_side % patch:
        raise ValueError(
            f"features.image.long_side must be a multiple of the network's patch, {patch}; got {long_side}"
        )
    columns, rows = (max(round(side * long_side / max(size) / patch), 1) for side in size)
    return columns, rows


def network_input(image: np.ndarray, grid: tuple[int, int], patch: int, config: ImageConfig) -> np.ndarray:
    """Normalised colours, float32 (3, rows·patch, columns·patch), of an RGB image (h, w, 3), uint8."""
    size = (grid[0] * patch, grid[1] * patch)
    is_smaller = size[0] < image.shape[1]
    values = image.astype(np.float32) / np.float32(255)
    # Cubic interpolation overshoots at edges.
    resized = cv2.resize(values, size, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC).clip(0, 1)
    normalised = (resized - np.asarray(config.mean, np.float32)) / np.asarray(config.std, np.float32)
    return np.ascontiguousarray(normalised.transpose(2, 0, 1))
