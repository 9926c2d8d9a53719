"""Foundations of all other modules: pytrees, small algebra, the camera, clustering and nearest neighbours."""
