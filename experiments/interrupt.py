"""Ctrl-C, and the SIGTERM of a scheduler, end a command with one word after it has written what it has."""

import contextlib
import gc
import os
import signal
import sys
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM, which what waits for Ctrl-C takes as that."""


RAISED = {signal.SIGTERM: Terminated, signal.SIGINT: KeyboardInterrupt}
_delays: Counter[int] = Counter()
AGAIN, MOST = 0.01, 100  # s, and how often


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise what the signal stands for; a little later where Python would print that and go on, but not for ever."""
    _delays[number] += 1
    if _is_lost(frame) and _delays[number] < MOST:
        threading.Timer(AGAIN, os.kill, (os.getpid(), number)).start()
    else:
        _delays[number] = 0
        raise RAISED[signal.Signals(number)]


def _is_lost(frame: FrameType | None) -> bool:
    """Whether a frame is inside a callback of the garbage collector (JAX has one) or of an object that goes."""
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    callbacks.add(weakref.finalize.__call__.__code__)
    while frame is not None:
        if frame.f_code in callbacks or frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


def _wait_for_threads(numbers: Iterable[int]) -> None:
    """Wait for threads that Python has given up; it waits for all others itself. The same signal again ends at once.

    Python before 3.13 takes a thread for ended where the `join` of it was interrupted. What such a thread computes is
    taken from under it as the program ends, and the program ends with SIGSEGV.
    """
    for number in numbers:
        signal.signal(number, lambda number, _: os._exit(128 + number))
    while not all(thread.is_alive() for thread in threading.enumerate()):
        time.sleep(AGAIN)


@contextlib.contextmanager
def clear_interrupt() -> Iterator[None]:
    """End the program with one word on Ctrl-C or SIGTERM; HYDRA_FULL_ERROR=1 shows where it was."""
    is_main = threading.current_thread() is threading.main_thread()
    heard = [number for number in RAISED if is_main and signal.getsignal(number) not in (signal.SIG_IGN, None)]
    before = {number: signal.signal(number, _interrupt) for number in heard}  # who started it may have it ignored
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        is_terminated = isinstance(interrupt, Terminated)
        print("terminated" if is_terminated else "interrupted", file=sys.stderr)
        _wait_for_threads(heard)
        raise SystemExit(128 + (signal.SIGTERM if is_terminated else signal.SIGINT)) from None  # as shells have it
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
