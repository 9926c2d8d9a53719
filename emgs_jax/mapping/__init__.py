"""Map a sequence: an immutable run, and functions from it and an input to the next run."""
