"""The radial distortion of a lens, one number k: a pinhole camera sees at x (1 + k |x|²) what the lens shows at x.

x is a pixel's place on the plane z = 1. Most cameras have |k| < .1, negative where straight lines bulge inwards.
"""

from dataclasses import dataclass
from typing import TypeVar

import cv2
import jax
import numpy as np
from jaxtyping import Float

Pixels = TypeVar("Pixels", np.ndarray, jax.Array)
NUM_STEPS = 10  # of the inversion; each leaves 3 k |x|², well below 1, of the error


@dataclass(frozen=True)
class Lens:
    """A camera whose lens is not a pinhole.

    Args:
        focal: fx, fy in pixels.
        center: cx, cy in pixels.
        distortion: k; 0 is a pinhole camera.
    """

    focal: np.ndarray
    center: np.ndarray
    distortion: float = 0.0


def undistort(pixels: Pixels, distortion: float | jax.Array, focal: Pixels, center: Pixels) -> Pixels:
    """Map pixels (…, 2) of the lens to those of a pinhole camera that sees the same; NumPy or JAX."""
    away = pixels - center
    return pixels + distortion * ((away / focal) ** 2).sum(-1)[..., None] * away


def straight(pixels: Float[np.ndarray, "*b 2"], lens: Lens) -> Float[np.ndarray, "*b 2"]:
    """`undistort` of a lens."""
    return undistort(pixels, lens.distortion, lens.focal, lens.center)


def distort(pixels: Float[np.ndarray, "*b 2"], lens: Lens) -> Float[np.ndarray, "*b 2"]:
    """Map pixels of a pinhole camera to those of the lens that show the same: the inverse of `straight`."""
    shown = pixels
    for _ in range(NUM_STEPS):
        shown = shown - (straight(shown, lens) - pixels)
    return shown


def grid(height: int, width: int) -> Float[np.ndarray, "h w 2"]:
    """(x, y) of every pixel."""
    return np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), axis=-1)


def rectify(images: Float[np.ndarray, "*b h w"], lens: Lens) -> Float[np.ndarray, "*b h w"]:
    """Images as a pinhole camera sees them; their border goes on where the lens shows nothing."""
    x, y = np.moveaxis(np.float32(distort(grid(*images.shape[-2:]), lens)), -1, 0)
    single = images.reshape(-1, *x.shape)
    found = [cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for image in single]
    return np.stack(found).reshape(images.shape)


def as_shown(values: Float[np.ndarray, "h w"], lens: Lens) -> Float[np.ndarray, "h w"]:
    """Resample an image of a pinhole camera at the pixels of the lens: the nearest value, 0 where there is none."""
    x, y = np.moveaxis(np.float32(straight(grid(*values.shape), lens)), -1, 0)
    return cv2.remap(values, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def points_shown(depth: Float[np.ndarray, "*b h w"], lens: Lens) -> Float[np.ndarray, "*b h w 3"]:
    """Camera-frame points at the depths z of the lens's pixels; 0 where the depth is."""
    on_plane = (straight(grid(*depth.shape[-2:]), lens) - lens.center) / lens.focal
    return depth[..., None] * np.concatenate([on_plane, np.ones((*on_plane.shape[:-1], 1))], axis=-1)
