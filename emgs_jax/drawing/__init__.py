"""Shared by pictures, pages and viewers: colours, layers of a map, splats, the overview."""
