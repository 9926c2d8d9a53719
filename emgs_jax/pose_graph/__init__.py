"""Poses that move when the camera comes back to a place: measurements between them, and the best poses for these."""
