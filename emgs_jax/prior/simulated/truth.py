"""The truth that is disturbed: check that frames have it, and measure how much of it two views share."""

from collections.abc import Collection, Sequence

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Frame
from emgs_jax.prior.base import Window, check_order


def no_truth(what: str) -> str:
    return f"prior=simulated needs a data set with ground truth; use prior=recorded or another data set: {what}"


def check_frames(window: Window, frames: Sequence[Frame], needed: Collection[int]) -> dict[int, Frame]:
    """The frames by index; ValueError if one has no pose, or one of `needed` no depth."""
    check_order(window, frames)
    for frame in frames:
        label = f"frame {frame.index} ({frame.name})"
        if frame.T_world_camera is None:
            raise ValueError(no_truth(f"{label} has no true pose"))
        if frame.index in needed and frame.depth is None:
            raise ValueError(no_truth(f"{label} has no depth"))
    if window.inference == 0 and not any((frame.depth > 0).any() for frame in frames if frame.index in needed):
        first = f"0 of the first {len(needed)} images, from {frames[0].name} on,"
        raise ValueError(no_truth(f"{first} have a true depth: it is 0 everywhere"))
    return {frame.index: frame for frame in frames}


def shared_points(a: Frame, b: Frame, intrinsics: Sequence[float], tolerance: float, num_columns: int) -> float:
    """Share of the points of a view, in [0, 1], that the other sees, up to a relative depth difference `tolerance`.

    The larger of both directions: a camera close to a wall that the other sees from afar shares all of its points.
    About `num_columns` points across the image are compared. A view without depth shares nothing.
    """
    step = max(1, a.depth.shape[1] // num_columns)
    return max(_share_seen(one, other, intrinsics, tolerance, step) for one, other in ((a, b), (b, a)))


def _share_seen(source: Frame, target: Frame, intrinsics: Sequence[float], tolerance: float, step: int) -> float:
    """Share of the points of every `step`-th pixel of `source` that `target` sees."""
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
