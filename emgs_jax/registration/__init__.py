"""Placing points on Gaussians: rigid motions, matching, ICP."""
