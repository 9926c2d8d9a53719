"""Whether the covariances of poses are those of their errors: `python -m tests.nees --runs 6`."""
