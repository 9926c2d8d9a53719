"""Ranges of values of config fields, declared with the field. Free of JAX, as recording a prior needs none either."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

MAX_LENGTH_M = 1e6  # of a coordinate; what is farther is damaged, or no length in metres: no map holds it
LARGE = 1e6  # what a field without a bound of its own may reach


class Range(NamedTuple):
    """Both ends are allowed; an infinite end says that infinity is."""

    low: float | int
    high: float | int


def ranged(low: float | int | None, high: float | int | None) -> Mapping[str, Any]:
    """Metadata of a field: its range where one of the ends is given."""
    if low is None and high is None:
        return {}
    return {"range": Range(-LARGE if low is None else low, LARGE if high is None else high)}


def number(default: Any = dataclasses.MISSING, low: float | int | None = None, high: float | int | None = None) -> Any:
    """A field of a plain dataclass that is one number, or several, from `low` to `high`."""
    return dataclasses.field(default=default, metadata=ranged(low, high))


def one_of(*names: str, default: Any = dataclasses.MISSING) -> Any:
    """A field of a plain dataclass that is one of `names`."""
    return dataclasses.field(default=default, metadata={"choices": names})
