"""Masks as run lengths."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool


def to_run_lengths(mask: Bool[np.ndarray, "h w"]) -> dict[str, Sequence[int]]:
    """Encode a mask as `size` (h, w) and `counts`: row by row, how many pixels are false, then true, then false, …"""
    changes = np.flatnonzero(np.diff(mask.ravel(), prepend=False))
    return {"size": list(mask.shape), "counts": np.diff(changes, prepend=0, append=mask.size).tolist()}


def from_run_lengths(runs: Mapping[str, Any]) -> Bool[np.ndarray, "h w"]:
    """Decode `to_run_lengths`; ValueError if the counts do not fill the size."""
    is_true = np.arange(len(runs["counts"])) % 2 == 1
    return np.repeat(is_true, runs["counts"]).reshape(runs["size"])
