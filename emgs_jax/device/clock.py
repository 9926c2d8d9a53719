"""Wall-clock time of a run: by phase, and the part for tracing, lowering and compiling."""

import contextlib
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import TypeVar

import jax.monitoring

Item = TypeVar("Item")
_COMPILING = ("jaxpr_trace_duration", "jaxpr_to_mlir_module_duration", "backend_compile_duration")


class Clock:
    """Wall-clock seconds by phase; while `watching`, also the seconds of JAX's compilations.

    Args:
        phases: name -> seconds, including compilation; time of an inner phase does not count in the outer one.
        compile_seconds: union of all spans in which a function was traced, lowered or compiled.
    """

    def __init__(self) -> None:
        self.phases: dict[str, float] = defaultdict(float)
        self.compile_seconds = 0.0
        self._begin = time.perf_counter()
        self._inner = 0.0  # seconds of the phases inside the current one
        self._spans: list[tuple[float, float]] = []  # disjoint and ascending

    @property
    def total_seconds(self) -> float:
        """Seconds since this clock was made."""
        return time.perf_counter() - self._begin

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the time inside the block as `name`."""
        begin, around, self._inner = time.perf_counter(), self._inner, 0.0
        try:
            yield
        finally:
            seconds = time.perf_counter() - begin
            self.phases[name] += seconds - self._inner
            self._inner = around + seconds

    def each(self, name: str, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items, and count the time to make each of them as `name`."""
        iterator, end = iter(items), object()
        while True:
            with self.phase(name):
                item = next(iterator, end)
            if item is end:
                return
            yield item

    @contextlib.contextmanager
    def watching(self) -> Iterator["Clock"]:
        """Record the compilations that JAX reports."""
        jax.monitoring.register_event_duration_secs_listener(self._hear)
        try:
            yield self
        finally:
            jax.monitoring.unregister_event_duration_listener(self._hear)

    def _hear(self, event: str, duration: float, **_: object) -> None:
        if event.rsplit("/", 1)[-1] in _COMPILING:
            end = time.perf_counter()
            self.add_span(end - duration, end)

    def add_span(self, begin: float, end: float) -> None:
        """Count a span that has just ended; since functions trace each other, it may contain earlier spans."""
        while self._spans and self._spans[-1][0] >= begin:
            inner = self._spans.pop()
            self.compile_seconds -= inner[1] - inner[0]
        begin = max(begin, self._spans[-1][1]) if self._spans else begin
        self._spans.append((begin, end))
        self.compile_seconds += end - begin


class Timer:
    """Seconds since it was made, and how many of them were compilation."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._begin, self._compiled = clock, time.perf_counter(), clock.compile_seconds

    def read(self) -> dict[str, float]:
        compiled = self._clock.compile_seconds - self._compiled
        return {"seconds": time.perf_counter() - self._begin, "compile_seconds": compiled}


def peak_memory_mb() -> float | None:
    """Return the peak resident size of this process in MiB; None if the system does not tell."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2.0**20 if sys.platform == "darwin" else 2.0**10)
