"""What the console can show."""

import io
import sys


def speak_on() -> None:
    """Write a sign that the console does not have as "?": it would end the program, at the last line of a long run."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
