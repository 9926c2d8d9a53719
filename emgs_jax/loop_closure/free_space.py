"""Free-space violations: does one camera see through a surface that the other sees? Then their relative pose is wrong.

Matches show what two images have in common, and miss what they have not: of two halls that look alike one ends earlier.
What is occluded from a camera is no evidence; a surface in its free space is.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from emgs_jax.geometry import transform_points
from emgs_jax.loop_closure.place_recognition import Keyframe, grid_pixels
from emgs_jax.loop_closure.two_view_refinement import Similarity


def free_space_violation(a: Keyframe, b: Keyframe, similarity: Similarity, margin: float) -> float:
    """Return the share of the surface seen by both cameras that lies in free space of the other; the larger of the two.

    Args:
        similarity: of camera b in the frame of a.
        margin: share of the depth by which it must be nearer than all that the other sees around it.
    """
    points_b = np.exp(similarity.log_ratio) * _points(b)
    T_b_a = np.linalg.inv(similarity.T_a_b)
    in_units_of_b = np.exp(-similarity.log_ratio)
    return max(
        _share(transform_points(similarity.T_a_b, points_b), a, margin),
        _share(in_units_of_b * transform_points(T_b_a, _points(a)), b, margin),
    )


def _points(keyframe: Keyframe) -> Float[np.ndarray, "n 3"]:
    """Camera-frame points of the keyframe's depth grid, where it has a depth."""
    fx, fy, cx, cy = keyframe.intrinsics
    x, y = np.meshgrid(*grid_pixels(keyframe.size, keyframe.depths.shape[::-1]))
    z = np.float64(keyframe.depths)
    return np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], axis=-1)[z > 0]


def _share(points: Float[np.ndarray, "n 3"], keyframe: Keyframe, margin: float) -> float:
    """Return the share of points in a keyframe's image that lie in front of its surface; 0 where it sees none."""
    fx, fy, cx, cy = keyframe.intrinsics
    (w, h), (rows, columns) = keyframe.size, keyframe.depths.shape
    points = points[points[:, 2] > 0]
    column = np.floor((points[:, 0] / points[:, 2] * fx + cx + 0.5) * columns / w)
    row = np.floor((points[:, 1] / points[:, 2] * fy + cy + 0.5) * rows / h)
    is_inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    # The nearest around: beside an edge the image may show the one surface and the point lie on the other. 0 = unknown.
    nearest = minimum_filter(np.float64(keyframe.depths), 3, mode="nearest")
    shown = nearest[row[is_inside].astype(int), column[is_inside].astype(int)]
    is_through = points[is_inside, 2] < (1 - margin) * shown
    return float(is_through.sum() / max((shown > 0).sum(), 1))
