"""Colours of statuses, paths and classes, and writing of pictures."""

import os
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from emgs_jax.io.files import atomic_write, write_file

STATUS_COLORS = {
    "tracked": "#2f9e6e",
    "degraded": "#e69f2e",
    "lost": "#d9413f",
    "initialization": "#4c7de0",
    "apart": "#9a6fc4",
    "skipped": "#a3aab5",
}


class Look(NamedTuple):
    """A path in pictures: its name for people, its colour on light paper and on a dark ground."""

    words: str
    paper: str
    dark: str


PATHS = {
    "poses": Look("estimated path", "#e4572e", "#ff6b4a"),
    "online": Look("estimated as placed", "#d9a514", "#f3c969"),
    "truth": Look("true path", "#1b998b", "#2fd1b2"),
    "raw": Look("raw prior's path", "#6b78e5", "#8f9bff"),
    "loops": Look("accepted loops", "#2e86e4", "#63e68b"),
}
OURS = PATHS["poses"].paper
NO_CLASS = "#5a6068"  # of pixels and points without a class


def rgb(color: str) -> np.ndarray:
    """Convert a colour "#rrggbb" to RGB in [0, 1] (3,)."""
    return np.frombuffer(bytes.fromhex(color[1:]), np.uint8) / 255.0


def class_colors(count: int) -> np.ndarray:
    """Return RGB in [0, 1] (count, 3): hues a golden section apart, alternately dark and light."""
    number = np.arange(count)[:, None]
    light = number % 2
    saturation, value = 0.8 - 0.3 * light, 0.65 + 0.3 * light
    sixth = (np.array([5, 3, 1]) + 6 * (0.618034 * number % 1.0)) % 6  # HSV to RGB, as Wikipedia has it
    return value - value * saturation * np.clip(np.minimum(sixth, 4 - sixth), 0, 1)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Convert values in [0, 1] to uint8; values outside are clipped, nan becomes 0."""
    return np.rint(255 * np.nan_to_num(values).clip(0.0, 1.0)).astype(np.uint8)


def save_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write RGB (h, w, 3) of 8 bits, or numbers (h, w) of 8 or 16 bits, as PNG, atomically."""
    write_file(path, cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)[1].tobytes())


def save_figure(path: str | os.PathLike, figure: Figure) -> None:
    """Write a figure as PNG, atomically; a "$" in its texts is literal, as in names of files and classes."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    with atomic_write(path) as handle:
        figure.savefig(handle, format="png", dpi=110)
