"""Ctrl-C ends a command with one word."""

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def clear_interrupt() -> Iterator[None]:
    """End the program with one word on Ctrl-C; HYDRA_FULL_ERROR=1 shows where it was."""
    try:
        yield
    except KeyboardInterrupt:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None  # 128 + SIGINT, as shells have it
