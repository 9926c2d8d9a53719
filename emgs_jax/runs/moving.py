"""Moving pixels: drawn over images, and as masks for other programs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from emgs_jax.data.reading import resize_nearest
from emgs_jax.io.run_lengths import from_run_lengths
from emgs_jax.runs.results import sound

MUCH = 0.03  # share of pixels; a smaller one may be wrong predictions
_TINT, _OPACITY = np.array([0, 230, 0]), 0.6


def moving_mask(line: Mapping[str, Any], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Return the moving pixels of a line of frames.jsonl in an image of (width, height); ValueError without a mask."""
    if not line.get("moving_pixels"):
        return np.zeros(size[::-1], bool)
    with sound(f"moving_pixels of frame {line.get('index')} in frames.jsonl is no mask"):
        found = from_run_lengths(line["moving_pixels"])
    return resize_nearest(found.astype(np.int32), size) > 0


def with_moving(image: UInt8[np.ndarray, "h w 3"], line: Mapping[str, Any]) -> UInt8[np.ndarray, "h w 3"]:
    """Colour an image green where something moves."""
    is_moving = moving_mask(line, image.shape[1::-1])[..., None]
    tinted = (1.0 - _OPACITY) * image + _OPACITY * _TINT
    return np.where(is_moving, tinted, image).astype(np.uint8)


def frame_facts(line: Mapping[str, Any]) -> str:
    """Describe a frame in one line of numbers."""
    known = {
        "inliers": lambda v: f"{v:,} inliers",
        "residual": lambda v: f"residual {100 * v:.1f} % of the depth",
        "scale": lambda v: f"scale {v:.3f}",
        "moving": lambda v: f"{100 * v:.0f} % moving" if v >= MUCH else "",
        "new": lambda v: f"{v:,} new",
        "num_gaussians": lambda v: f"{v:,} Gaussians",
        "seconds": lambda v: f"{v:.2f} s",
    }
    found = [say(line[name]) for name, say in known.items() if isinstance(line.get(name), int | float)]
    return " · ".join(filter(None, found))
