"""Images of more than 8 bits, shown in 8: sensors fill 10, 12 or 14 of 16, and their images would be almost black."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError

MAX_LOOKED_AT = 16  # images, evenly spread: all become 8 bits alike, or the brightness would flicker
OUTLIERS_PERCENT = 0.1  # of the pixels at either end: dead and hot ones
MIN_SPAN = 0.5  # of the 16 bits; what spans more is shown as it is
MIN_FOOT = 0.25  # of the highest value: below that black stays black


@dataclass(frozen=True)
class Tones:
    """The values that become 0 and 255."""

    low: float
    high: float

    @property
    def note(self) -> str:
        return f"images have more than 8 bits: their values from {self.low:g} to {self.high:g} are shown as 0 to 255"

    def shown(self, image: np.ndarray) -> UInt8[np.ndarray, "..."]:
        """The image in 8 bits; one that has 8 stays."""
        if image.dtype == np.uint8:
            return image
        share = (np.nan_to_num(image.astype(np.float32)) - self.low) / (self.high - self.low)
        return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)


ALL_16_BITS = Tones(0.0, 65535.0)


def find_tones(read: Callable[[int], np.ndarray], count: int) -> Tones | None:
    """Find the range of grey values that is shown in 8 bits, from a sample of `count` images.

    Args:
        read: image 0..count-1 in its own bits; raises BadFrameError.

    Returns:
        None for images of 8 bits, for 16 bits of which more than MIN_SPAN is used, and where no image can be read.
        Among others those of 8 bits do not count: they stay as they are.
    """
    ends, dtype = [], None
    for row in dict.fromkeys(np.linspace(0, count - 1, min(count, MAX_LOOKED_AT)).astype(int).tolist()):
        try:
            image = read(row)
        except BadFrameError:
            continue
        if image.dtype == np.uint8:
            continue
        dtype = image.dtype
        ends.append(np.nanpercentile(image, (OUTLIERS_PERCENT, 100 - OUTLIERS_PERCENT)))
    if not ends:
        return None
    low, high = float(np.min(ends)), float(np.max(ends))
    if dtype == np.uint16 and high - low > MIN_SPAN * np.iinfo(dtype).max:
        return None
    low = low if low > MIN_FOOT * high else min(low, 0.0)
    return Tones(low, high if high > low else low + 1.0)


def tones_of(files: Sequence[Path]) -> Tones | None:
    """Those of image files, of which some may have more bits than others."""
    deep = [path for path in files if reading.may_be_deep(path)]
    return find_tones(lambda row: reading.decode(deep[row], reading.OWN_BITS), len(deep))


def read_shown(
    path: Path, raw_size: reading.Size | None, tones: Tones | None, flags: int = 0
) -> UInt8[np.ndarray, "_ _ 3"]:
    """`reading.read_color` of an image that may have more than 8 bits."""
    if tones is None:
        return reading.read_color(path, raw_size, flags)
    image = reading.decode(path, reading.OWN_BITS | flags)
    reading.check_raw_size(image, raw_size, path)
    return np.ascontiguousarray(tones.shown(image)[..., ::-1])
