"""The lens that the images were taken with, between their pixels and those of a pinhole camera that sees the same."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from emgs_jax.data.camera_models import project


@dataclass(frozen=True)
class Lens:
    """A pinhole camera, and what of it the images show."""

    focal: np.ndarray  # fx, fy of the pinhole camera in pixels
    center: np.ndarray  # cx, cy likewise
    # (h, w, 2) float32, the image's pixel that shows what each of the pinhole camera's sees; None: its own
    shown: np.ndarray | None = None
    straight: np.ndarray | None = None  # (h, w, 2) float32, the inverse


def lens_of(camera: Any, intrinsics: tuple[float, ...], size: tuple[int, int]) -> Lens:
    """The lens of images of this (width, height), from pycolmap's camera of the same images in any size.

    Args:
        intrinsics: fx, fy, cx, cy of the pinhole camera at `size`.
    """
    focal, center = np.float64(intrinsics[:2]), np.float64(intrinsics[2:])
    ratio = np.array(size) / (camera.width, camera.height)  # borders lie on borders; COLMAP counts from them
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2).astype(float)
    shown = project(camera, (pixels - center) / focal) * ratio - 0.5
    straight = focal * camera.cam_from_img((pixels + 0.5) / ratio) + center
    if max(np.abs(shown - pixels).max(), np.abs(straight - pixels).max()) < 0.01:
        return Lens(np.float32(focal), np.float32(center))
    shown, straight = (np.float32(found).reshape(size[1], size[0], 2) for found in (shown, straight))
    return Lens(np.float32(focal), np.float32(center), shown, straight)


def rectify(image: np.ndarray, lens: Lens) -> np.ndarray:
    """An image (h, w) or (h, w, c) as the pinhole camera sees it; its border goes on where the lens shows nothing."""
    if lens.shown is None:
        return image
    return cv2.remap(image, lens.shown, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def as_shown(values: Float[np.ndarray, "h w"], lens: Lens) -> Float[np.ndarray, "h w"]:
    """Values of the pinhole camera at the pixels of the images: the nearest, 0 where there is none."""
    if lens.straight is None:
        return values
    return cv2.remap(values, lens.straight, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def points_shown(depth: Float[np.ndarray, "h w"], lens: Lens) -> Float[np.ndarray, "h w 3"]:
    """Camera-frame points at the depths z of the images' pixels; 0 where the depth is."""
    height, width = depth.shape
    pixels = lens.straight if lens.straight is not None else np.stack(np.meshgrid(*map(np.arange, (width, height))), -1)
    on_plane = (pixels - lens.center) / lens.focal
    return np.float32(depth[..., None] * np.concatenate([on_plane, np.ones((height, width, 1))], axis=-1))
