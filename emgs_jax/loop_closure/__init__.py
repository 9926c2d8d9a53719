"""Loop closure: place recognition, verification and spatial consistency of loops, and relocalization."""
