"""Times as programs write them (seconds, or clocks that count smaller units), and what is nearest to them in time."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

UNITS = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}  # how many are a second
EPOCH = 1e9, 4.2e9  # seconds since 1970, from 2001 to 2103
MIN_STEP_US, MIN_STEP_NS = 1e4, 1e6  # between two images; as seconds that would be hours
MIN_CLOCK = 1e7  # no count of frames is so high; it is of a clock
MAX_UPTIME_S, TYPICAL_STEP_S = 4e7, 1 / 30  # since a boot, and between two images


def unit_of(times: np.ndarray) -> str:
    """The unit in which numbers (n,), ascending, are times: one of UNITS; "seconds" too where they may be no times.

    What counts from 1970 says its unit by its size. What counts from elsewhere (a boot) does by the step from one image
    to the next: it is the unit in which that is most like the step of a video. Below `MIN_CLOCK` that is said of
    microseconds and nanoseconds only, as steps of 33 may be those of frame numbers.
    """
    for unit, per_second in UNITS.items():
        if len(times) and EPOCH[0] <= np.min(times) / per_second and np.max(times) / per_second <= EPOCH[1]:
            return unit
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if step > 0 and np.min(times) >= MIN_CLOCK:
        fits = {unit: abs(math.log(step / per / TYPICAL_STEP_S)) for unit, per in UNITS.items()}
        likely = [unit for unit, per_second in UNITS.items() if np.max(times) / per_second <= MAX_UPTIME_S]
        return min(likely or ["nanoseconds"], key=lambda unit: fits[unit])
    return "nanoseconds" if step >= MIN_STEP_NS else "microseconds" if step >= MIN_STEP_US else "seconds"


def in_seconds(times: np.ndarray) -> np.ndarray:
    """Numbers (n,), ascending, as seconds; float64."""
    return np.asarray(times, np.float64) / UNITS[unit_of(times)]


def resolution(*times: np.ndarray) -> float:
    """Seconds by which float64 may miss times so large: no two of them are told apart by less."""
    return float(np.spacing(max((np.abs(values).max(initial=0.0) for values in times), default=0.0)))


def matched_rows(
    times: Float[np.ndarray, " n"], candidates: Float[np.ndarray, " m"], tolerance: float, of: tuple[str, Path]
) -> list[int]:
    """`nearest_rows`, which some image must have; `of` says what of and where it is listed."""
    rows = nearest_rows(times, candidates, tolerance)
    if max(rows) < 0:
        what, path = of
        raise ValueError(
            f"{path}: 0 of {len(rows)} images have a {what} (max difference {tolerance:g} s): the images are at "
            f"{_span(times)} s, the lines of this file at {_span(candidates)} s. Correct the times, choose other "
            "images (dataset.start, stop), raise dataset.max_time_difference, or move the file away"
        )
    return rows


def _span(times: Float[np.ndarray, " n"]) -> str:
    return f"{times.min():.3f} to {times.max():.3f}" if len(times) else "no"


def nearest_rows(times: Float[np.ndarray, " n"], candidates: Float[np.ndarray, " m"], tolerance: float) -> list[int]:
    """Row of `candidates` (ascending) nearest to each time, -1 where none is within the tolerance in seconds.

    Times that differ by the tolerance are within it, however float64 rounds them: seconds since 1970 by 2e-7.
    """
    if len(candidates) == 0:
        return [-1] * len(times)
    after = np.clip(np.searchsorted(candidates, times), 1, max(len(candidates) - 1, 1))
    pair = np.stack([after - 1, np.minimum(after, len(candidates) - 1)])
    gaps = np.abs(candidates[pair] - times)
    best = gaps.argmin(axis=0)
    rows = np.take_along_axis(pair, best[None], 0)[0]
    return np.where(gaps.min(axis=0) <= tolerance + resolution(times, candidates), rows, -1).tolist()


def check_tolerance(seconds: float) -> float:
    """`dataset.max_time_difference` as finite seconds, 0 or more."""
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"dataset.max_time_difference must be seconds, 0 or more, got {seconds}")
    return float(seconds)
