"""The unit of a structure from images alone: metres, by a length, positions or motions that are known."""
