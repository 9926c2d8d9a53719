"""Runs on disk: write, read, merge, export, polish and query them."""
