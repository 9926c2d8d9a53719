"""Bonn RGB-D Dynamic: TUM's layout, with poses of markers on the sensor in the axes of a motion capture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.data.reading import Number
from emgs_jax.data.tum import TumLayout

# The authors' transforms: T_g, world from camera, is T_ROS^-1 T T_ROS T_M with the markers' pose T of groundtruth.txt.
# T_M has a scale of 1.0593, by which depths fall short of the motion capture's metres; it is in `depth_scale` here, so
# that poses stay rigid.
T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])  # is its own inverse
T_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
CALIBRATION = (542.822841, 542.576870, 315.593520, 237.756098), (0.039903, -0.099343, -0.000730, -0.000144, 0.0)


@dataclass(eq=False)
class Bonn(TumLayout):
    """One sequence of Bonn RGB-D Dynamic, such as "rgbd_bonn_balloon", in metres of the motion capture."""

    depth_scale: Number = 4720.1

    name = "bonn"
    source = "Bonn RGB-D Dynamic Dataset, project page of the Photogrammetry and Robotics Lab of the University of Bonn"
    calibrations = {"": CALIBRATION}  # of all sequences

    def pose(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        T_capture_markers = super().pose(index)
        return None if T_capture_markers is None else T_ROS @ T_capture_markers @ T_ROS @ markers_camera()


def markers_camera() -> Float[np.ndarray, "4 4"]:
    """T_M without its scale: the rigid motion from the camera to the markers."""
    left, _, right = np.linalg.svd(T_M[:3, :3])
    motion = T_M.copy()
    motion[:3, :3] = left @ right
    return motion
