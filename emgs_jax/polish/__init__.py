"""Appearance by gradient descent: splats of the pixels' resolution on the map's surface, fitted to the images."""
