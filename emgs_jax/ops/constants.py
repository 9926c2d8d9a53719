"""Numbers and signs that both the device and the host need, without JAX."""

MAD_TO_STD = 1.4826  # standard deviation of a normal distribution over its median absolute value


# Signs of a pose's columns: OpenCV's axes (y down, z ahead) from OpenGL's (y up, z back), and back.
FLIP = (1.0, -1.0, -1.0, 1.0)
