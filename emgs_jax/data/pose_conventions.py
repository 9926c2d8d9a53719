"""Conventions in which programs write poses: functions that convert a pose that was read in the wrong one."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from emgs_jax.ops.constants import FLIP

EXPECTED = "poses camera -> world, quaternions x, y, z, w, axes of OpenCV (x right, y down, z ahead)"
AHEAD_LEFT_UP = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # OpenCV's axes in robots' axes
AHEAD_RIGHT_DOWN = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def _scalar_first(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The pose whose quaternion w, x, y, z was read as x, y, z, w."""
    from scipy.spatial.transform import Rotation  # slow to import, rarely needed

    changed = pose.copy()
    changed[:3, :3] = Rotation.from_quat(Rotation.from_matrix(pose[:3, :3]).as_quat()[[1, 2, 3, 0]]).as_matrix()
    return changed


READINGS: Mapping[str, Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]]] = {
    "world -> camera": np.linalg.inv,
    "camera -> world of OpenGL's axes": lambda pose: pose * FLIP,
    "world -> camera of OpenGL's axes": lambda pose: np.linalg.inv(pose) * FLIP,
    "of axes x ahead, y left, z up": lambda pose: pose @ AHEAD_LEFT_UP,
    "of axes x ahead, y right, z down": lambda pose: pose @ AHEAD_RIGHT_DOWN,
    "with quaternions w, x, y, z": _scalar_first,
    "world -> camera with quaternions w, x, y, z": lambda pose: np.linalg.inv(_scalar_first(pose)),
}
