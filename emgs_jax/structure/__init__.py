"""Structure from motion by COLMAP, of all images at once or of those that have come."""
