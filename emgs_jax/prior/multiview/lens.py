"""Resample between the images' pixels, as the lens took them, and those of a pinhole camera."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from emgs_jax.data.camera_models import project


@dataclass(frozen=True)
class Lens:
    """A pinhole camera, and maps between its pixels and those of the images."""

    focal: np.ndarray  # fx, fy of the pinhole camera in pixels
    center: np.ndarray  # cx, cy likewise
    shown: np.ndarray | None = None  # (h, w, 2) float32, image pixel of each pinhole pixel; None: the same
    straight: np.ndarray | None = None  # (h, w, 2) float32, the inverse


def lens_of(camera: Any, intrinsics: tuple[float, ...], size: tuple[int, int]) -> Lens:
    """The lens of images of (width, height) `size` by pycolmap's camera in any size, to a pinhole camera at `size`."""
    focal, center = np.float64(intrinsics[:2]), np.float64(intrinsics[2:])
    ratio = np.array(size) / (camera.width, camera.height)  # COLMAP counts pixels from the border
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2).astype(float)
    shown = project(camera, (pixels - center) / focal) * ratio - 0.5
    straight = focal * camera.cam_from_img((pixels + 0.5) / ratio) + center
    if max(np.abs(shown - pixels).max(), np.abs(straight - pixels).max()) < 0.01:
        return Lens(np.float32(focal), np.float32(center))
    shown, straight = (np.float32(found).reshape(size[1], size[0], 2) for found in (shown, straight))
    return Lens(np.float32(focal), np.float32(center), shown, straight)


def rectify(image: np.ndarray, lens: Lens) -> np.ndarray:
    """Resample an image (h, w) or (h, w, c) to the pinhole camera; its border is replicated."""
    if lens.shown is None:
        return image
    return cv2.remap(image, lens.shown, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def as_shown(values: Float[np.ndarray, "h w"], lens: Lens) -> Float[np.ndarray, "h w"]:
    """Resample values of the pinhole camera to the images, by the nearest; 0 where there is none."""
    if lens.straight is None:
        return values
    return cv2.remap(values, lens.straight, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def points_shown(depth: Float[np.ndarray, "h w"], lens: Lens) -> Float[np.ndarray, "h w 3"]:
    """Camera-frame points of the images' depths z; 0 where the depth is 0."""
    height, width = depth.shape
    pixels = lens.straight if lens.straight is not None else np.stack(np.meshgrid(*map(np.arange, (width, height))), -1)
    on_plane = (pixels - lens.center) / lens.focal
    return np.float32(depth[..., None] * np.concatenate([on_plane, np.ones((height, width, 1))], axis=-1))
