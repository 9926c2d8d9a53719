"""Programs and arrays on the device: compilation ahead of use, JAX's settings, and timing."""
