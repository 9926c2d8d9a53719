"""Times as programs write them: seconds, or clocks that count milliseconds, microseconds or nanoseconds."""

import numpy as np

UNITS = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}  # how many are a second
EPOCH = 1e9, 4.2e9  # seconds since 1970, from 2001 to 2103
MIN_STEP_US, MIN_STEP_NS = 1e4, 1e6  # between two images; as seconds that would be hours


def unit_of(times: np.ndarray) -> str:
    """The unit in which numbers (n,), ascending, are times: one of UNITS; "seconds" too where they may be no times.

    What counts from 1970 says its unit by its size. What counts from elsewhere (a boot) does by the step from one image
    to the next, for microseconds and nanoseconds; steps of 33 may be those of frame numbers.
    """
    for unit, per_second in UNITS.items():
        if len(times) and EPOCH[0] <= np.min(times) / per_second and np.max(times) / per_second <= EPOCH[1]:
            return unit
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return "nanoseconds" if step >= MIN_STEP_NS else "microseconds" if step >= MIN_STEP_US else "seconds"


def in_seconds(times: np.ndarray) -> np.ndarray:
    """Numbers (n,), ascending, as seconds; float64."""
    return np.asarray(times, np.float64) / UNITS[unit_of(times)]


def resolution(*times: np.ndarray) -> float:
    """Seconds by which float64 may miss times so large: no two of them are told apart by less."""
    return float(np.spacing(max((np.abs(values).max(initial=0.0) for values in times), default=0.0)))
