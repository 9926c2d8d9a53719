"""How far a depth may be off: by the baseline, by its cost curve, and by what other views say.

    σ² = (pixel_std / g)² + (spread_std s)² + (difference_std δ)²

is the variance of log z, the common scale apart. g is by how many pixels the point moves in a source while log z grows
by one, f b / z where the baseline b is sideways, so without a baseline σ is infinite. s tells how wide the minimum of
the cost curve is, δ by how much the depths of other views differ. The factors are those of maximum likelihood (of a
Student t, as some depths are outliers), on scenes whose depth is known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class DepthNoiseConfig:
    """Its parts, as numbers that `docs/measurements/depth_noise.md` tells the origin of, and what is too much."""

    pixel_std: float = number(low=0)  # pixels; of a match
    spread_std: float = number(low=0)  # where the spread of a cost curve is 1, see `Stereo`
    difference_std: float = number(low=0)  # where other views differ by as much as the depth itself
    max_std: float = number(low=0)  # of a depth that is predicted


def relative_std(
    pixels: Float[np.ndarray, "h w"],
    spread: Float[np.ndarray, "h w"],
    difference: Float[np.ndarray, "h w"],
    config: DepthNoiseConfig,
) -> Float[np.ndarray, "h w"]:
    """Standard deviation of log z; inf where no source moves or no view confirms.

    Args:
        pixels: g, see `pixels_per_log_depth`.
        spread: s, see `Stereo`.
        difference: δ, see `mean_difference`.
    """
    by_match = config.pixel_std / np.where(pixels > 0, pixels, 1.0)
    parts = by_match, config.spread_std * spread, config.difference_std * difference
    return np.float32(np.where(pixels > 0, np.sqrt(sum(part**2 for part in parts)), np.inf))
