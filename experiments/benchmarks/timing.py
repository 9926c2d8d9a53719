"""Seconds, compile and run time apart: candidates take turns, so that what else the machine does meets all of them."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax


@dataclass(frozen=True)
class Candidate:
    """Something to time.

    Args:
        call: returns when its result is there.
        compile_seconds: of tracing and compiling; None where nothing is compiled.
        facts: what else was found, for example errors, sizes and ratios.
    """

    call: Callable[[], Any]
    compile_seconds: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Timing:
    """One row of a table: a candidate's seconds in every turn, and what is known of it."""

    part: str
    name: str
    seconds: list[float]
    compile_seconds: float | None
    facts: dict[str, Any]


def called(verb: Callable, *arguments: Any) -> Candidate:
    """`verb` as users call it: its first call compiles, and what that takes longer than a second one is compilation."""
    call = lambda: jax.block_until_ready(verb(*arguments))  # noqa: E731
    first, second = _seconds(call), _seconds(call)
    return Candidate(call, max(first - second, 0.0))


def _seconds(call: Callable) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def interleaved(part: str, candidates: Mapping[str, Candidate], repetitions: int) -> list[Timing]:
    """Time all candidates in turns, after one turn that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for repetition in range(repetitions + 1):
        for name, candidate in candidates.items():
            taken = _seconds(candidate.call)
            if repetition > 0:
                seconds[name].append(taken)
    return [Timing(part, name, seconds[name], c.compile_seconds, dict(c.facts)) for name, c in candidates.items()]


def compare(timings: Sequence[Timing], reference: str) -> list[Timing]:
    """Add to every other row how many times as long as it the reference takes: median and range over the turns."""
    (base,) = (timing for timing in timings if timing.name == reference)
    for timing in timings:
        if timing is not base:
            turns = zip(base.seconds, timing.seconds, strict=True)
            timing.facts["times_faster_than"] = {reference: spread([theirs / ours for theirs, ours in turns])}
    return list(timings)


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Median, smallest and largest."""
    return statistics.median(values), min(values), max(values)
