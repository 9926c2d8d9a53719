"""Map images of more than 8 bits to 8: sensors fill 10, 12 or 14 of 16 bits, which would be almost black."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError

MAX_LOOKED_AT = 16  # images, evenly spread; one range for all, or the brightness would flicker
OUTLIERS_PERCENT = 0.1  # dead and hot pixels at either end
MIN_SPAN = 0.5  # of the 16 bits; a larger range is not stretched
MIN_FOOT = 0.25  # of the highest value; a lower minimum stays 0


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
    """Find the range of values to show in 8 bits, from a sample of `count` images; images of 8 bits do not count.

    None if all have 8 bits, if more than MIN_SPAN of 16 bits is used, or if none can be read (BadFrameError).
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
    """The tones of image files, which may have different bits."""
    deep = [path for path in files if reading.may_be_deep(path)]
    return find_tones(lambda row: reading.decode(deep[row], reading.OWN_BITS), len(deep))


def read_shown(
    path: Path, raw_size: reading.Size | None, tones: Tones | None, flags: int = 0
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Read an RGB image, turned by its EXIF unless `flags` has AS_STORED; BadFrameError unless it has `raw_size`."""
    image = reading.decode(path, flags | (cv2.IMREAD_COLOR if tones is None else reading.OWN_BITS))
    reading.check_raw_size(image, raw_size, path)
    return cv2.cvtColor(image if tones is None else tones.shown(image), cv2.COLOR_BGR2RGB)
