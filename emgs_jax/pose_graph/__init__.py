"""Pose graph: measurements between poses, the poses that fit them best, and the map that deforms with them."""
