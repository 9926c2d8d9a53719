"""What the console can show, whether there still is one, and a copy of what it is told."""

import io
import os
import sys
from typing import Any, TextIO


class Console:
    """A console for as long as someone reads it: when a reader such as `head` has gone, the rest goes nowhere.

    A long run would end there with its work undone. What is written goes into `file`, too.
    """

    def __init__(self, console: Any, file: TextIO | None = None) -> None:
        self._console, self._file = console, file

    def write(self, text: str) -> int:
        if self._file is not None:
            self._file.write(text)
        try:
            self._console.write(text)
        except BrokenPipeError:
            self._leave()
        return len(text)

    def flush(self) -> None:
        try:
            self._console.flush()
        except BrokenPipeError:
            self._leave()

    def _leave(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._console.fileno())
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._console, name)


def speak_on() -> None:
    """Write a sign that the console does not have as "?", and on when nobody reads: both would end the program."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
            setattr(sys, name, Console(stream))
