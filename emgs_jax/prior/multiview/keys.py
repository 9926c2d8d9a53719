"""Key views: which views stay in the structure when they leave the window.

A window spans as much of the walk as its images do: of a video that is centimetres, in which no landmark has parallax,
and the scale walks. Views that lie farther apart hold it (Klein and Murray, "Parallel tracking and mapping", 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.landmarks import Structure, View, known_common


@dataclass(frozen=True)
class KeyConfig:
    """Selection of keyframes: views that stay when they leave the window.

    Args:
        max_keys: beside those of the window; those go first that share least with its newest view. 0: none stays.
        min_shift: median distance between the images of a landmark in a view and in the keyframe before it, from which
            on the view is a keyframe, too; as a fraction of the image's width.
    """

    max_keys: int = number(low=0, high=1000)
    min_shift: float = number(low=0)


def key_views(structure: Structure, views: Sequence[int], width: int, config: KeyConfig) -> list[int]:
    """The placed views, none of `views`, that are far from each other: keys until now, and what leaves the window.

    Args:
        structure: of the window before.
        views: of the window.
        width: of the images, pixels.
        config: how far apart.
    """
    placed = structure.placed()
    keys: list[int] = []
    for frame in sorted(frame for frame in placed if frame not in views):
        if not keys or _shift(structure, placed[keys[-1]], placed[frame]) >= config.min_shift * width:
            keys.append(frame)
    return keys


def kept(structure: Structure, keys: Sequence[int], config: KeyConfig) -> list[int]:
    """Those of the key views that stay: they share most with the newest view."""
    placed = structure.placed()
    shared = {frame: len(known_common(structure, placed[frame], placed[max(placed)])[0]) for frame in keys}
    return sorted(sorted(keys, key=lambda frame: (-shared[frame], -frame))[: config.max_keys])


def _shift(structure: Structure, a: View, b: View) -> float:
    """Median distance in pixels between the images of what both show; inf where that is nothing."""
    rows_a, rows_b = known_common(structure, a, b)
    return float(np.median(np.linalg.norm(a.pixels[rows_a] - b.pixels[rows_b], axis=1))) if len(rows_a) else np.inf
