"""A sequence being mapped: frames, prior, step, record; one run or many configs side by side."""
