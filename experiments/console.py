"""A console that may lack characters or go away, and a copy of its output."""

import io
import os
import sys
from typing import Any, TextIO


class Console:
    """A console whose reader, such as `head`, may go away without ending the program; copies all output to `file`."""

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
    """Replace characters that the console lacks by "?", and go on when nobody reads; both would end the program."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
            setattr(sys, name, Console(stream))
