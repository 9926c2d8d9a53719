"""Frames as they come: sources of images, and the data set that they make."""
