"""Structure from motion of all images at once, by COLMAP."""
