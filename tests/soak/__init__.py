"""Long runs and hard scenes in one process: `python -m tests.soak --steps 10000`."""
