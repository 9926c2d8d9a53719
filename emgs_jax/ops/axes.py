"""Axes of cameras."""

# Signs of a pose's columns: OpenCV's axes (y down, z ahead) from OpenGL's (y up, z back), and back.
FLIP = (1.0, -1.0, -1.0, 1.0)
