"""Ctrl-C, and the SIGTERM of a scheduler, end a command with one word after it has written what it has."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM, which what waits for Ctrl-C takes as that."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


@contextlib.contextmanager
def clear_interrupt() -> Iterator[None]:
    """End the program with one word on Ctrl-C or SIGTERM; HYDRA_FULL_ERROR=1 shows where it was."""
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _terminate) if is_main else None
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        is_terminated = isinstance(interrupt, Terminated)
        print("terminated" if is_terminated else "interrupted", file=sys.stderr)
        raise SystemExit(128 + (signal.SIGTERM if is_terminated else signal.SIGINT)) from None  # as shells have it
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, before)
