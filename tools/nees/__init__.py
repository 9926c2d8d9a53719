"""Check that the covariances of poses are those of their errors: `python -m tools.nees --runs 6`."""
