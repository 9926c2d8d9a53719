"""The images of which a structure is made, and the files of COLMAP beside them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

DATABASE, IMAGES = "database.db", "images"


class Shots(NamedTuple):
    """Images of one camera."""

    names: Sequence[str]  # distinct
    read: Callable[[int], np.ndarray]  # RGB uint8 (h, w, 3) of an image; raises BadFrameError
    size: tuple[int, int]  # (width, height)
    camera: tuple[str, tuple[float, ...]]  # COLMAP's model, and parameters in its pixels, or none: its default start
    is_calibrated: bool  # only the distortion may still change
    mask: Callable[[int], np.ndarray | None] = lambda _: None  # bool (h, w), True where an image is left out
    poses: np.ndarray | None = None  # (n, 4, 4) T_world_camera in metres, NaN without one, at which a model is made
