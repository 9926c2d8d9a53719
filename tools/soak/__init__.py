"""Long runs and hard scenes in one process: `python -m tools.soak --steps 10000`."""
