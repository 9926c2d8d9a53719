"""Depth images to points, without JAX; `camera.unproject` does the same on the device."""

from collections.abc import Sequence

import numpy as np


def backproject(depth: np.ndarray, intrinsics: Sequence[float]) -> np.ndarray:
    """Camera-frame points (..., h, w, 3), float64, of depth images (..., h, w) of camera-space z; fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics
    v, u = np.indices(depth.shape[-2:])
    return np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=-1)
