"""Depth images to points on the host, where JAX may not be; `camera.unproject` does the same on the device."""

from collections.abc import Sequence

import numpy as np


def backproject(depth: np.ndarray, intrinsics: Sequence[float]) -> np.ndarray:
    """Camera-frame points (..., h, w, 3) of depth images (..., h, w), float64; pixel centres at integers.

    Args:
        depth: camera-space z.
        intrinsics: fx, fy, cx, cy.
    """
    fx, fy, cx, cy = intrinsics
    v, u = np.indices(depth.shape[-2:])
    return np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=-1)
