"""Ranges of config fields, declared with the field. Without JAX, which recording a prior does not need either."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

MAX_LENGTH_M = 1e6  # of a coordinate; a larger one is damaged or not in metres, and no map holds it
LARGE = 1e6  # bound of a field without a bound of its own


class Range(NamedTuple):
    """A range that includes both ends; infinity is allowed if an end is infinite."""

    low: float | int
    high: float | int


def ranged(low: float | int | None, high: float | int | None) -> Mapping[str, Any]:
    """Make the metadata of a field: its range, if an end is given."""
    if low is None and high is None:
        return {}
    return {"range": Range(-LARGE if low is None else low, LARGE if high is None else high)}


def number(default: Any = dataclasses.MISSING, low: float | int | None = None, high: float | int | None = None) -> Any:
    """Declare a field of a plain dataclass: one number, or several, from `low` to `high`."""
    return dataclasses.field(default=default, metadata=ranged(low, high))


def one_of(*names: str, default: Any = dataclasses.MISSING) -> Any:
    """Declare a field of a plain dataclass that is one of `names`."""
    return dataclasses.field(default=default, metadata={"choices": names})
