"""Seconds, compile and run time apart: candidates take turns, so that what else the machine does meets all of them."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax


@dataclass(frozen=True)
class Timing:
    """One row of a table.

    Args:
        compile_seconds: of tracing and compiling; None where nothing is compiled.
        facts: what else was found, for example errors, sizes and ratios.
    """

    part: str
    name: str
    seconds: list[float]
    compile_seconds: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Candidate:
    """Something to time.

    Args:
        call: returns when its result is there.
        compile_seconds: as in `Timing`; likewise
        verb: what `call` calls, for other arguments of the same shapes.
    """

    call: Callable[[], Any]
    compile_seconds: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    verb: Callable | None = None


def executable(verb: Callable, *arguments: Any) -> Candidate:
    """`verb` compiled for `arguments`, with the seconds that took and the memory that it needs."""
    begin = time.perf_counter()
    compiled = eqx.filter_jit(verb).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    memory = compiled.compiled.memory_analysis()
    used = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    call = lambda: jax.block_until_ready(compiled(*arguments))  # noqa: E731
    return Candidate(call, seconds, {"memory_mb": used / 2**20}, compiled)


def called(verb: Callable, *arguments: Any) -> Candidate:
    """`verb` as users call it: its first call compiles, and what that takes longer than a second one is compilation."""
    call = lambda: jax.block_until_ready(verb(*arguments))  # noqa: E731
    first, second = _seconds(call), _seconds(call)
    return Candidate(call, max(first - second, 0.0), {}, verb)


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
