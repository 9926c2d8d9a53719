"""Pose graph of a run, as data and functions: add nodes, detect and verify loops, optimize, deform."""
