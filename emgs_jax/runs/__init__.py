"""Runs on disk: their files written, read, merged, exported, polished and asked for words."""
