"""Which splats touch which tile of the image."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.neighbours import compact_rows
from emgs_jax.render.project import Splats


def tile_corners(camera: Camera, tile_size: int) -> Float[Array, "t 2"]:
    """Pixel (x, y) of the upper left corner of every tile, row-major; the last tiles may reach over the border."""
    x = jnp.arange(0, camera.width, tile_size, dtype=jnp.float32)
    y = jnp.arange(0, camera.height, tile_size, dtype=jnp.float32)
    return jnp.stack(jnp.meshgrid(x, y, indexing="xy"), axis=-1).reshape(-1, 2)


def assign_tiles(
    splats: Splats, corners: Float[Array, "t 2"], tile_size: int, capacity: int, radius: Float[Array, ""]
) -> tuple[Int[Array, "t c"], Bool[Array, "t c"], Int[Array, "t"]]:
    """Splats whose bounding box of `radius` standard deviations meets the tile, nearest first.

    Returns:
        Rows of the splats, which of them exist, and per tile how many did not fit and are therefore not drawn.
    """
    order = jnp.argsort(jnp.where(splats.valid, splats.depth, jnp.inf), stable=True)
    half = radius * jnp.sqrt(jnp.stack([splats.covs[:, 0, 0], splats.covs[:, 1, 1]], axis=-1))
    low, high, valid = ((x)[order] for x in (splats.means - half, splats.means + half, splats.valid))

    def assign(corner: Float[Array, "2"]) -> tuple[Int[Array, "c"], Bool[Array, "c"], Int[Array, ""]]:
        is_near = jnp.all((high >= corner) & (low <= corner + (tile_size - 1)), axis=-1) & valid
        ranks, exists, overflow = compact_rows(is_near, capacity)
        return jnp.take(order, ranks, mode="clip"), exists, overflow

    return jax.vmap(assign)(corners)
