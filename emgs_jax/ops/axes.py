"""Axes of cameras."""

import numpy as np

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes (y down, z ahead) from OpenGL's (y up, z back), and back
