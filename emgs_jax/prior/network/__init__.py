"""Feed-forward networks of MapAnything's framework."""
