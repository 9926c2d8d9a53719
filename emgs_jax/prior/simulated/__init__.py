"""Ground truth, disturbed the way a feed-forward model errs."""
