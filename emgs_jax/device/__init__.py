"""Programs and arrays on the device: executables kept on disk, JAX's settings, and the time that they take."""
