"""Times as programs write them, in seconds or smaller units, and nearest neighbours in time."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

UNITS = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}  # number in a second
EPOCH = 1e9, 4.2e9  # seconds since 1970, from 2001 to 2103
MIN_STEP_US, MIN_STEP_NS = 1e4, 1e6  # between two images; as seconds these would be hours
MIN_CLOCK = 1e7  # of a clock; frame numbers are smaller
MAX_UPTIME_S, TYPICAL_STEP_S = 4e7, 1 / 30  # since a boot, and between two images


def unit_of(times: np.ndarray) -> str:
    """Guess the unit, one of UNITS, of ascending times (n,); "seconds" if they may be no times.

    Times since 1970 tell it by their size, other clocks by the step between images, which should be like a video's.
    Below `MIN_CLOCK` steps of 33 may be those of frame numbers, so only microseconds and nanoseconds are recognised.
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
    """Ascending times (n,) as seconds, float64, by `unit_of`."""
    return np.asarray(times, np.float64) / UNITS[unit_of(times)]


def resolution(*times: np.ndarray) -> float:
    """The rounding error of float64 for times of this size, in seconds."""
    return float(np.spacing(max((np.abs(values).max(initial=0.0) for values in times), default=0.0)))


def matched_rows(
    times: Float[np.ndarray, " n"], candidates: Float[np.ndarray, " m"], tolerance: float, of: tuple[str, Path]
) -> list[int]:
    """`nearest_rows`; ValueError if no image has one. `of` says of what, and names the file."""
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
    """Row of the ascending `candidates` nearest to each time, -1 if none is within the tolerance (s) and rounding."""
    if len(candidates) == 0:
        return [-1] * len(times)
    after = np.clip(np.searchsorted(candidates, times), 1, max(len(candidates) - 1, 1))
    pair = np.stack([after - 1, np.minimum(after, len(candidates) - 1)])
    gaps = np.abs(candidates[pair] - times)
    best = gaps.argmin(axis=0)
    rows = np.take_along_axis(pair, best[None], 0)[0]
    return np.where(gaps.min(axis=0) <= tolerance + resolution(times, candidates), rows, -1).tolist()


def check_tolerance(seconds: float) -> float:
    """Check that `dataset.max_time_difference` is finite and not negative."""
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"dataset.max_time_difference must be seconds, 0 or more, got {seconds}")
    return float(seconds)
