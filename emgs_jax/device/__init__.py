"""Programs and arrays on the device: what is compiled ahead, JAX's settings, and the time that they take."""
