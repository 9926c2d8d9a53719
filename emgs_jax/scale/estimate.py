"""A scale with its uncertainty, and several of them as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAX_CHI_SQ = 4.0  # per degree of freedom; beyond, scales disagree


@dataclass(frozen=True)
class Scale:
    """Metres of a unit of length.

    Args:
        source: what it comes from, for people.
        log: logarithm of the metres of one unit.
        std: standard deviation of `log`.
    """

    source: str
    log: float
    std: float

    @property
    def factor(self) -> float:
        """Metres of one unit."""
        return float(np.exp(self.log))


def scale_from(source: str, metres: float, units: float, std: float) -> Scale:
    """Make a scale by which `units` are `metres`; `std` is that of the logarithm of their ratio."""
    return Scale(source, float(np.log(metres / units)), float(std))


def combined(scales: Sequence[Scale]) -> tuple[Scale, str | None]:
    """Combine independent scales, at least one: log s = Σ log s_k / σ_k² / Σ 1 / σ_k².

    Scales that disagree, with χ² = Σ (log s_k - log s)² / σ_k² above `MAX_CHI_SQ` per degree of freedom, have larger
    errors than they say: all σ_k are multiplied by the root of χ² per degree of freedom (Birge 1932).

    Returns:
        The scale, and a warning if they disagree.
    """
    weights = np.array([1.0 / scale.std**2 for scale in scales])
    logs = np.array([scale.log for scale in scales])
    log = float(weights @ logs / weights.sum())
    std = float(weights.sum() ** -0.5)
    each = ", ".join(f"{one.source} (± {100 * one.std:.1f} %)" for one in scales)
    chi_sq = float(weights @ (logs - log) ** 2) / max(len(scales) - 1, 1)
    if chi_sq <= MAX_CHI_SQ:
        return Scale(each, log, std), None
    most = ", ".join(f"{one.source}: {100 * np.expm1(one.log - log):+.0f} %" for one in scales)
    return Scale(each, log, std * chi_sq**0.5), f"the lengths disagree ({most}): check them"
