"""The viewer in a browser, of a finished run or of one that is mapping."""
