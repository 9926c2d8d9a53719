"""A length that was measured between two pixels of an image."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from emgs_jax.scale.estimate import Scale, scale_from

CLICK_STD = 1.0  # of each pixel, in those of the frame
REACH = 2  # pixels beside the one that is given


def scale_of_distance(
    points: Float[np.ndarray, "2 3"], depth_std: Float[np.ndarray, "2"], focal: float, metres: float, source: str
) -> Scale:
    """Compare the distance of two points of a frame with its metres.

    The points err along their rays, by a share of their depth, and beside them by a pixel. With u the direction from
    one to the other and L their distance, σ² = Σ (u·p σ_z)² / L² for independent depths, at least that of an error that
    both share, which is σ_z itself.

    Args:
        points: in the camera's axes, any unit.
        depth_std: of the logarithm of each depth.
        focal: in pixels of the frame.

    Raises:
        ValueError: the points are one.
    """
    apart = points[1] - points[0]
    units = float(np.linalg.norm(apart))
    if not units > 0:
        raise ValueError(f"scale.distance: both pixels of {source} show one point: choose points far apart")
    along = points @ (apart / units) * depth_std
    beside = CLICK_STD * points[:, 2] / focal
    variance = max(float(along @ along) / units**2, float(np.mean(depth_std)) ** 2) + float(beside @ beside) / units**2
    return scale_from(source, metres, units, variance**0.5)


def point_at(
    points: Float[np.ndarray, "h w 3"],
    std: Float[np.ndarray, "h w"],
    pixel: Float[np.ndarray, "2"],
    focal: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Return the point of a frame at a pixel, and the standard deviation of the logarithm of its depth.

    It is on the ray of the pixel itself, which those of its neighbours tell, with the median depth within `REACH`
    pixels. If that varies there, as at an edge, its spread counts.

    Args:
        points: in the camera's axes, 0 where there is none.
        pixel: column and row.
        focal: fx and fy in pixels of the frame.

    Returns:
        None where no depth is known near the pixel, or outside of the frame.
    """
    column, row = np.rint(pixel).astype(int)
    if not (0 <= row < len(points) and 0 <= column < points.shape[1]):
        return None
    rows, columns = np.indices(std.shape)
    near = slice(max(row - REACH, 0), row + REACH + 1), slice(max(column - REACH, 0), column + REACH + 1)
    is_known = points[near][..., 2] > 0
    if not is_known.any():
        return None
    some, stds = points[near][is_known].astype(np.float64), std[near][is_known]
    pixels = np.stack([columns[near][is_known], rows[near][is_known]], axis=-1)
    logs = np.log(some[:, 2])
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    depth = some[np.argmin(np.abs(logs - middle)), 2]
    on_plane = np.median(some[:, :2] / some[:, 2:] + (pixel - pixels) / focal, axis=0)
    return depth * np.append(on_plane, 1.0), float(np.hypot(np.median(stds), spread))


def pixel_in(
    point: Float[np.ndarray, "3"], T_world_camera: Float[np.ndarray, "4 4"], intrinsics: Sequence[float]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Return the pixel (column, row) of a point of the world in a frame, and its depth, which is not above 0 behind."""
    x, y, z = T_world_camera[:3, :3].T @ (point - T_world_camera[:3, 3])
    fx, fy, cx, cy = intrinsics
    return (np.array([fx * x / z + cx, fy * y / z + cy]) if z > 0 else np.full(2, np.nan)), float(z)


def spread_of(depths: Sequence[float], said: Sequence[float]) -> float:
    """Return how far frames are from a point's depth: 1.4826 times the median of |log(said / depth)|; 0 without any.

    Where stereo errs, frames differ by far more than they say; one behind another surface is among few.

    Args:
        depths: of the point in each other frame.
        said: what that frame has at its pixel.
    """
    off = np.abs(np.log(np.asarray(said, np.float64) / np.asarray(depths, np.float64)))
    return 1.4826 * float(np.median(off)) if len(off) else 0.0
