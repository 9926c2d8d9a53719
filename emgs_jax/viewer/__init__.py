"""The viewer in a browser, for a finished run or one that is mapping."""
