"""Probability that a depth is right: the minimum of its cost curve is distinct, and other views confirm it.

    p = p_photo(spread) p_geo(agreement)

is the probability that the depth errs by less than 3 %, the common scale apart. The two tests fail for different
reasons, so what passes both is right more often than what passes either. Both are piecewise linear and monotonic, the
least squares of "errs by less" (the Brier score; isotonic regression: Zadrozny and Elkan, KDD 2002).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class ConfidenceConfig:
    """The two factors, as numbers that `docs/priors.md` tells the origin of.

    Args:
        spreads: planes, rising; what lies outside is as the nearest.
        photo: p_photo at each of them, falling.
        geo: p_geo where the views' agreement adds up to 0, 1, 2, …, rising.
    """

    spreads: tuple[float, ...] = number(low=0)
    photo: tuple[float, ...] = number(low=0, high=1)
    geo: tuple[float, ...] = number(low=0, high=1)

    def __post_init__(self) -> None:
        rising = (*np.diff(self.spreads), *-np.diff(self.photo), *np.diff(self.geo))
        if len(self.spreads) != len(self.photo) or min(rising) < 0:
            raise ValueError("of a confidence, spreads and geo must rise and photo fall, with a photo for each spread")


def probability(
    spread: Float[np.ndarray, "h w"], agreement: Float[np.ndarray, "h w"], config: ConfidenceConfig
) -> Float[np.ndarray, "h w"]:
    """That a depth errs by less than 3 %; what stands for a pixel without depth means nothing.

    Args:
        spread: see `estimate_depth` and `fill_planes`, planes of the sweep.
        agreement: of other views, see there.
        config: both factors.
    """
    photo = np.interp(spread, config.spreads, config.photo)
    return np.float32(photo * np.interp(agreement, np.arange(len(config.geo)), config.geo))
