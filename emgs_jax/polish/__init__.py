"""Appearance by gradient descent: fit splats at pixel resolution, on the map's surface, to the images."""
