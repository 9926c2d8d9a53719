"""The newest image of a source that does not wait: a queue would fall behind."""

import contextlib
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from emgs_jax.data.base import BadFrameError


@dataclass(frozen=True)
class Shot:
    """One image of a camera.

    Args:
        time: seconds, of the camera's own clock where it has one.
        image: RGB, uint8 (h, w, 3).
        given: what came with it, named as in a file of prior=files: depth (h', w') in metres, 0 = none; T_world_camera
            (4, 4), NaN where unknown; intrinsics of the depth, without them those of the image.
        arrived: of `time.monotonic`.
    """

    time: float
    image: np.ndarray
    given: dict[str, np.ndarray] | None = None
    arrived: float = 0.0


LAST_S = 1.0  # longest wait for the thread of a source that has ended: a device may not come back
Unread: TypeAlias = Callable[[], Shot]  # reads and decodes an image; BadFrameError if it cannot be used


class Newest:
    """The newest image of a source, until it is taken; those that newer ones replace are counted, and never read.

    Attributes:
        num_dropped: images that came and were not taken.
        reason: why no more will come; None while they may.
        problem: why images that came could not be used; None if there was nothing.
        begun: set once images are wanted; a source that can wait, such as a recording, begins then.
        can_wait: the source does so, and its images are all wanted.
    """

    def __init__(self) -> None:
        self._changed, self._shot = threading.Condition(), None  # the latter with the time when it came
        self.num_dropped, self.reason, self.problem = 0, None, None
        self.begun, self.can_wait = threading.Event(), False
        self._thread: threading.Thread | None = None
        _running.add(self)

    def fill(self, give: Callable[[], None], name: str) -> None:
        """Call what offers the images, and returns once no more are wanted, in a thread."""
        self._thread = threading.Thread(target=give, name=name, daemon=True)
        self._thread.start()

    def put(self, shot: Shot | Unread) -> bool:
        """Offer an image; returns False if no more are wanted."""
        with self._changed:
            if self.reason is not None:
                return False
            self.num_dropped += self._shot is not None
            self._shot = shot, time.monotonic()
            self._changed.notify_all()
            return True

    @property
    def is_over(self) -> bool:
        """Whether the last image has been taken."""
        with self._changed:
            return self.reason is not None and self._shot is None

    def take(self, timeout_s: float | None) -> Shot | None:
        """Wait for an image, take and read it; None after the last one, or if none comes in time (None: for ever).

        One that cannot be used is a `problem`, and the next one is waited for.
        """
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            with self._changed:
                rest = None if end is None else max(end - time.monotonic(), 0.0)
                self._changed.wait_for(lambda: self._shot is not None or self.reason is not None, rest)
                found, self._shot = self._shot, None
            if found is None:
                return None
            shot, arrived = found
            try:
                shot = replace(shot if isinstance(shot, Shot) else shot(), arrived=arrived)
            except BadFrameError as error:
                self.problem = str(error)
                continue
            self.problem = None
            return shot

    def end(self, reason: str) -> None:
        """Let no more images come; the first reason stays."""
        with self._changed:
            self.reason = reason if self.reason is None else self.reason
            self._changed.notify_all()
        self.begun.set()  # a source that waits for it is not wanted

    def close(self) -> None:
        """End, and wait for the thread: one in rclpy aborts the process if it still runs as Python ends."""
        self.end("the run has ended")
        if self._thread is not None:
            self._thread.join(LAST_S)


_running: "weakref.WeakSet[Newest]" = weakref.WeakSet()  # cameras of this process


def end_all() -> bool:
    """Let the cameras of this process give no more images; returns False if none is running."""
    running = [newest for newest in _running if newest.reason is None]
    for newest in running:
        newest.end("ended by the user")
    return bool(running)


@contextlib.contextmanager
def all_closed() -> Iterator[None]:
    """Close the cameras of this process after the block, however it ends."""
    try:
        yield
    finally:
        for newest in [*_running]:
            newest.close()
