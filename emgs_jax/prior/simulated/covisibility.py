"""Covisibility of two views with true depth and poses: the share of their points that both see."""

from collections.abc import Sequence

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Frame


def shared_points(a: Frame, b: Frame, intrinsics: Sequence[float], tolerance: float, num_columns: int) -> float:
    """Return the share of its points, in 0..1, that the view with the larger share has in common with the other.

    The larger of the two directions: a camera close to a wall that the other one sees from afar shares all of its
    points, though hardly any of the other's. A view without depth shares nothing. The value is the same for (b, a).

    Args:
        a, b: with true depth, metres, and true poses.
        intrinsics: fx, fy, cx, cy in pixels, of both.
        tolerance: relative difference in depth up to which a point counts as the one that is seen there.
        num_columns: points across an image, about; rows are as far from each other as columns.
    """
    return max(
        _share_seen(one, other, intrinsics, tolerance, max(1, a.depth.shape[1] // num_columns))
        for one, other in ((a, b), (b, a))
    )


def _share_seen(source: Frame, target: Frame, intrinsics: Sequence[float], tolerance: float, step: int) -> float:
    """Share of the points of every `step`-th pixel of `source` that are the first surface on their ray in `target`."""
    fx, fy, cx, cy = intrinsics
    z = source.depth[::step, ::step]
    valid = np.isfinite(z) & (z > 0)
    if not valid.any():
        return 0.0
    points = backproject(source.depth, intrinsics)[::step, ::step][valid]
    T_target_source = np.linalg.inv(target.T_world_camera) @ source.T_world_camera
    x, y, z = (np.einsum("ij,pj->pi", T_target_source[:3, :3], points) + T_target_source[:3, 3]).T
    ahead = z > 0
    z = np.where(ahead, z, 1.0)
    column, row = np.rint(fx * x / z + cx), np.rint(fy * y / z + cy)
    h, w = target.depth.shape
    inside = ahead & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    seen = target.depth[row[inside].astype(int), column[inside].astype(int)]
    is_same = np.abs(seen - z[inside]) <= tolerance * z[inside]  # false where a depth is 0 or not finite
    return float(is_same.sum() / valid.sum())
