"""Standard deviation of a depth, from the baseline, the cost curve and the depths of other views.

The variance of log z, apart from a common scale, is

    σ² = (pixel_std / g)² + (spread_std s)² + (difference_std δ)²

where g is the motion of the point in a source per unit of log z (f b / z for a sideways baseline b), s the width of the
cost curve's minimum, and δ the difference from the depths of other views. The factors are of maximum likelihood (of a
Student t, as some depths are outliers) on scenes with known depth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class DepthNoiseConfig:
    """Factors of the three terms, see `docs/measurements/depth_noise.md`, and the largest standard deviation."""

    pixel_std: float = number(low=0)  # of a match, pixels
    spread_std: float = number(low=0)  # per unit of spread, see `Stereo`
    difference_std: float = number(low=0)  # per unit of relative difference
    max_std: float = number(low=0)  # of a predicted depth


def relative_std(
    pixels: Float[np.ndarray, "h w"],
    spread: Float[np.ndarray, "h w"],
    difference: Float[np.ndarray, "h w"],
    config: DepthNoiseConfig,
) -> Float[np.ndarray, "h w"]:
    """Standard deviation of log z from g, s and δ (see above); inf where no source moves or no view confirms."""
    by_match = config.pixel_std / np.where(pixels > 0, pixels, 1.0)
    parts = by_match, config.spread_std * spread, config.difference_std * difference
    return np.float32(np.where(pixels > 0, np.sqrt(sum(part**2 for part in parts)), np.inf))
