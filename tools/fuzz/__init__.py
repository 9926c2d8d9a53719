"""Damaged inputs of every kind: `python -m tools.fuzz --cases 10000 --seed 0`."""
