"""End a command on Ctrl-C or a scheduler's SIGTERM with one word, after it has written its results."""

import _weakrefset
import contextlib
import gc
import os
import signal
import sys
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM, handled like Ctrl-C."""


RAISED = {signal.SIGTERM: Terminated, signal.SIGINT: KeyboardInterrupt}
_delays: Counter[int] = Counter()
AGAIN, MOST = 0.01, 100  # s between tries, and their number
_WEAK = weakref.__file__, _weakrefset.__file__  # with callbacks that remove dead references


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise the signal's exception; try again later, but not for ever, if Python would only print it."""
    _delays[number] += 1
    if _is_lost(frame) and _delays[number] < MOST:
        threading.Timer(AGAIN, _send, (number,)).start()
    else:
        _delays[number] = 0
        raise RAISED[signal.Signals(number)]


def _send(number: int) -> None:
    """Send this process a signal; on Windows os.kill would end it."""
    signal.raise_signal(number) if os.name == "nt" else os.kill(os.getpid(), number)


def _is_lost(frame: FrameType | None) -> bool:
    """Test whether a frame is in a callback of the garbage collector, a finalizer or a weak reference.

    Python prints an exception there, and goes on. JAX has such a callback.
    """
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    callbacks.add(weakref.finalize.__call__.__code__)
    while frame is not None:
        is_of_weakref = frame.f_code.co_filename in _WEAK and frame.f_code.co_name in ("remove", "_remove")
        if frame.f_code in callbacks or frame.f_code.co_name == "__del__" or is_of_weakref:
            return True
        frame = frame.f_back
    return False


def _end(number: int, _: FrameType | None = None) -> None:
    """Print one word and leave at once, after everything is written.

    Python's own shutdown would not wait for daemon threads, as of SciPy's trees, or for threads whose `join` was
    interrupted, and end with SIGSEGV; it would only print an exception.
    """
    word = "terminated" if number == signal.SIGTERM else "interrupted"
    with contextlib.suppress(OSError):
        os.write(2, f"{word}\n".encode())
    with contextlib.suppress(OSError, ValueError, RuntimeError):  # closed, or a print is being interrupted
        sys.stdout.flush()
    os._exit(128 + number)  # as in shells


def _heard() -> list[signal.Signals]:
    """Signals that this thread may handle, unless the parent process has them ignored."""
    is_main = threading.current_thread() is threading.main_thread()
    return [number for number in RAISED if is_main and signal.getsignal(number) not in (signal.SIG_IGN, None)]


def end_clearly() -> None:
    """End with one word outside of `clear_interrupt` too, as imports take seconds."""
    for number in _heard():
        signal.signal(number, _end)


@contextlib.contextmanager
def clear_interrupt() -> Iterator[None]:
    """End the program with one word on Ctrl-C or SIGTERM; HYDRA_FULL_ERROR=1 shows where it was."""
    heard = _heard()
    before = {number: signal.signal(number, _interrupt) for number in heard}
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        _end(signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def cameras_first(end_all: Callable[[], bool]) -> Iterator[None]:
    """Let Ctrl-C end the cameras that are running, so that the map of their images is finished; else end the run."""
    if signal.SIGINT not in _heard():
        yield
        return

    def first(number: int, frame: FrameType | None) -> None:
        if not end_all():
            before(number, frame)
            return
        os.write(2, b"\nno more images are taken; the map is finished and written (Ctrl-C again stops at once)\n")

    before = signal.signal(signal.SIGINT, first)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
