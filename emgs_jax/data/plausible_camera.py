"""Check intrinsics for plausibility, and recognise likely mistakes: another image size, order or unit."""

import math

import numpy as np

from emgs_jax.data.reading import Intrinsics, Size, resize_intrinsics

USUAL_VIEW_DEG = 10.0, 150.0  # of pinhole cameras
NARROWEST_VIEW_DEG = 2.0  # of a telescope
MAX_OFFSET = 0.1  # of the principal point from the middle, as a share of the side
MAX_ALIKE, ALIKE = 0.04, 0.012  # likewise if both shares are equal, as in another resolution
MAX_SQUEEZE = 0.1  # of fx / fy from 1
FIT = 0.03  # distance from the middle and from square pixels at which another reading fits


def view_deg(intrinsics: Intrinsics, size: Size) -> tuple[float, float]:
    """Horizontal and vertical angle of view in degrees, if the principal point is in the middle."""
    return tuple(math.degrees(2 * math.atan(size[i] / (2 * intrinsics[i]))) for i in (0, 1))


def oddities(intrinsics: Intrinsics, size: Size) -> list[str]:
    """Describe what is unusual about a camera for images of (width, height)."""
    found, views = [], view_deg(intrinsics, size)
    for angle, side in zip(views, ("wide", "high"), strict=True):
        if not USUAL_VIEW_DEG[0] <= angle <= USUAL_VIEW_DEG[1]:
            found.append(f"the view is {angle:.3g} degrees {side}")
    offsets = _offsets(intrinsics, size)
    limit = MAX_ALIKE if abs(offsets[0] - offsets[1]) < ALIKE else MAX_OFFSET
    for offset, side in zip(offsets, ("width", "height"), strict=True):
        if abs(offset) > limit:
            found.append(f"the principal point is {100 * abs(offset):.0f} % of the {side} from the middle")
    if abs(math.log(intrinsics[0] / intrinsics[1])) > math.log1p(MAX_SQUEEZE):
        found.append(f"pixels would not be square (fx / fy = {intrinsics[0] / intrinsics[1]:.3g})")
    return found


def is_impossible(intrinsics: Intrinsics, size: Size) -> bool:
    views = view_deg(intrinsics, size)
    return not (min(views) >= NARROWEST_VIEW_DEG and max(views) <= USUAL_VIEW_DEG[1])


def other_reading(numbers: Intrinsics, size: Size) -> str | None:
    """Describe another order, unit or image size in which the numbers fit, with the intrinsics; None without."""
    (a, b, c, d), (w, h) = numbers, size
    scaled = w / (2 * (c + 0.5))
    readings = {
        "normalised by width and height": (a * w, b * h, c * w - 0.5, d * h - 0.5),
        "normalised by the width": (a * w, b * w, c * w - 0.5, d * w - 0.5),
        "in the order fx, cx, fy, cy": (a, c, b, d),
        "in the order cx, cy, fx, fy": (c, d, a, b),
        "with cx and cy exchanged (of images that are turned)": (a, b, d, c),
        f"of images of {w / scaled:.0f}x{h / scaled:.0f}": resize_intrinsics(numbers, (1, 1), (scaled, scaled)),
    }
    for reading, values in readings.items():
        if min(values[:2]) > 0 and not np.allclose(values, numbers, rtol=FIT) and _fits(values, size):
            return f"they fit as those {reading}: give [{', '.join(f'{value:.6g}' for value in values)}]"
    return None


def _offsets(intrinsics: Intrinsics, size: Size) -> tuple[float, float]:
    """Offset of the principal point from the middle, as shares of width and height."""
    return tuple((intrinsics[2 + i] + 0.5) / size[i] - 0.5 for i in (0, 1))


def _fits(intrinsics: Intrinsics, size: Size) -> bool:
    squeeze = abs(math.log(intrinsics[0] / intrinsics[1]))
    is_central = np.abs(_offsets(intrinsics, size)).max() <= FIT
    return bool(is_central and squeeze <= FIT and not is_impossible(intrinsics, size))
