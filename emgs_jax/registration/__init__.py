"""Registration of points to Gaussians: rigid motions, matching, ICP."""
