"""Numbers that both the device and the host need, without JAX."""

MAD_TO_STD = 1.4826  # standard deviation of a normal distribution over its median absolute value
