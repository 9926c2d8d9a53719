"""Classical multi-view geometry from the images alone."""
