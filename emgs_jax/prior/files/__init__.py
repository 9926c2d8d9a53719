"""Predictions that stand in files, one a frame: `prior=files`."""
