"""Runs that are killed at any time and go on: `python -m tools.kills --kills 50 --seed 0`."""
