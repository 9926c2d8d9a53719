"""A sequence being mapped: an immutable run, and functions from it and an input to the next one."""
