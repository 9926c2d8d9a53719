"""The pinhole camera: the only place where pixels meet rays. OpenCV axes, pixel centres at integer coordinates."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.pytree import static, traced

NEAREST_DEPTH = 1e-6  # m; a nearer point, or one behind the camera, has no pixel


class Camera(eqx.Module):
    """Intrinsics of an image of static size.

    Args:
        focal: fx, fy in pixels.
        center: cx, cy in pixels.
    """

    focal: Float[Array, "2"] = traced()
    center: Float[Array, "2"] = traced()
    width: int = static()
    height: int = static()


def downscale(camera: Camera, stride: int) -> Camera:
    """Make the camera of every `stride`-th row and column: its pixel (i, j) is (stride·i, stride·j) of `camera`."""
    size = -(-camera.width // stride), -(-camera.height // stride)
    return Camera(camera.focal / stride, camera.center / stride, *size)


def pixel_grid(camera: Camera) -> Float[Array, "h w 2"]:
    """Make the coordinates (x, y) of every pixel."""
    x = jnp.arange(camera.width, dtype=jnp.float32)
    y = jnp.arange(camera.height, dtype=jnp.float32)
    return jnp.stack(jnp.meshgrid(x, y, indexing="xy"), axis=-1)


def project(camera: Camera, points: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 2"], Float[Array, "*b"]]:
    """Project camera-frame points to pixel coordinates and depth z; points not in front project as from z = 1 m."""
    depth = points[..., 2]
    safe_depth = jnp.where(depth > NEAREST_DEPTH, depth, 1.0)
    return camera.focal * points[..., :2] / safe_depth[..., None] + camera.center, depth


def nearest_pixel(pixels: Float[Array, "*b 2"], size: tuple[int, int]) -> tuple[Int[Array, "*b"], Bool[Array, "*b"]]:
    """Find the row-major index of the nearest pixel in an image of (height, width), and whether it is in the image.

    Outside the index is 0.
    """
    height, width = size
    column, row = jnp.moveaxis(jnp.round(pixels), -1, 0)  # which may be larger than any integer
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = (jnp.where(inside, x, 0.0).astype(jnp.int32) for x in (column, row))
    return row * width + column, inside


def rays(camera: Camera, pixels: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """Compute viewing directions with z = 1 in the camera frame."""
    xy = (pixels - camera.center) / camera.focal
    return jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)


def unproject(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Convert a depth image to camera-frame points; depth 0 gives the origin."""
    return rays(camera, pixel_grid(camera)) * depth[..., None]
