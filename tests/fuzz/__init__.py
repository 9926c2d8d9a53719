"""Damaged inputs of every kind: `python -m tests.fuzz --cases 10000 --seed 0`."""
