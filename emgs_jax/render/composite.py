"""Front-to-back compositing of one tile, and the image from all of them."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int, PyTree

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import fill_rows, static, take_rows, traced
from emgs_jax.render.project import Splats, project_gaussians
from emgs_jax.render.tiles import assign_tiles, tile_corners

OPAQUE = 0.99  # coverage of a pixel behind which nothing changes it by more than a hundredth
NUM_SIZES = 3  # programs for tiles of the capacity, half and a quarter of it, which most tiles of a map do not exceed
Tile: TypeAlias = tuple[Array, Array, Array]  # corner, rows of its splats, which of them exist
Sums: TypeAlias = tuple[Float[Array, "q v"], Float[Array, "q"], Float[Array, "q"], Float[Array, "q"]]


class RenderConfig(eqx.Module):
    """How the map is drawn.

    Args:
        tile_size: pixels along a tile's side.
        tile_capacity: splats that one tile can hold, the nearest; `Rendering.overflow` counts those that are missed.
        tile_batch: tiles that are drawn at once, which bounds the memory.
        opacity: of every Gaussian at its centre (the paper's constant opacity).
        covariance_scale: factor on the covariances, so that neighbouring Gaussians close the surface.
        blur: pixels²; low-pass filter.
        radius: standard deviations beyond which a splat is not drawn.
        min_alpha: a pixel with less coverage has no depth.
    """

    tile_size: int = static(low=1, high=1024)
    tile_capacity: int = static(low=1, high=2**20)
    tile_batch: int = static(low=1, high=2**20)
    opacity: Float[Array, "*b"] = traced(low=0, high=1)
    covariance_scale: Float[Array, "*b"] = traced(low=1e-6)
    blur: Float[Array, "*b"] = traced(low=0)
    radius: Float[Array, "*b"] = traced(low=0)
    min_alpha: Float[Array, "*b"] = traced(low=0, high=1)


class Rendering(eqx.Module):
    """Images of the map.

    Args:
        values: composited values (not divided by alpha; 0 where nothing is).
        alpha: coverage in [0, 1].
        depth: expected camera-space z in metres; 0 where alpha is below `min_alpha`.
        depth_std: standard deviation in metres of the depth over the splats of a pixel: large where two surfaces mix.
        overflow: splats that were not drawn because their tile was full, summed over the tiles in which something is
            seen behind the nearest; where every pixel is opaque they are hidden.
    """

    values: Float[Array, "h w c"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    depth_std: Float[Array, "h w"]
    overflow: Int[Array, ""]


def splat_alpha(splats: Splats, pixels: Float[Array, "q 2"], config: RenderConfig) -> Float[Array, "c q"]:
    """Opacity of every splat at every pixel: opacity · exp(-½ d²); 0 beyond `radius` standard deviations."""
    offset = pixels[None] - splats.means[:, None]
    precision = splats.precisions
    distance_sq = (
        precision[:, None, 0, 0] * offset[..., 0] ** 2
        + 2.0 * precision[:, None, 0, 1] * offset[..., 0] * offset[..., 1]
        + precision[:, None, 1, 1] * offset[..., 1] ** 2
    )
    alpha = config.opacity * jnp.exp(-0.5 * distance_sq)
    return jnp.where((distance_sq <= config.radius**2) & splats.valid[:, None], alpha, 0.0)


def splat_depth(splats: Splats, pixels: Float[Array, "q 2"], config: RenderConfig) -> Float[Array, "c q"]:
    """Camera-space z of every splat's plane at every pixel, kept within the splat's own extent in depth."""
    offset = pixels[None] - splats.means[:, None]
    inverse = splats.inverse_depth[:, None] + jnp.sum(splats.depth_slope[:, None] * offset, axis=-1)
    reach = config.radius * splats.depth_std
    nearest, farthest = splats.depth - reach, splats.depth + reach
    highest = 1.0 / jnp.maximum(nearest, 0.1 * splats.depth)
    return 1.0 / jnp.clip(inverse, (1.0 / farthest)[:, None], highest[:, None])


def blend_weights(
    splats: Splats, pixels: Float[Array, "q 2"], config: RenderConfig
) -> tuple[Float[Array, "c q"], Float[Array, "c q"]]:
    """Share of every splat of a tile, nearest first, in the light of every pixel, and its depth there (m)."""
    alpha = splat_alpha(splats, pixels, config)
    log_light = jnp.cumsum(jnp.log1p(-jnp.minimum(alpha, 0.999)), axis=0)
    light_before = jnp.exp(jnp.concatenate([jnp.zeros_like(log_light[:1]), log_light[:-1]]))
    weights = alpha * light_before
    # An invalid row may hold any depth; its weight is 0, and 0 · inf would be NaN.
    return weights, jnp.where(weights > 0, splat_depth(splats, pixels, config), 0.0)


def weighted_sums(weights: Float[Array, "c q"], depth: Float[Array, "c q"], values: Float[Array, "c v"]) -> Sums:
    """Σ w v, Σ w, Σ w z and Σ w z² of every pixel."""
    return weights.T @ values, weights.sum(0), (weights * depth).sum(0), (weights * depth**2).sum(0)


def composite(splats: Splats, values: Float[Array, "c v"], pixels: Float[Array, "q 2"], config: RenderConfig) -> Sums:
    """Blend the splats of one tile, which come nearest first: values, alpha, Σ w z, Σ w z²."""
    return weighted_sums(*blend_weights(splats, pixels, config), values)


@full_precision
def render(
    gaussians: Gaussians,
    values: Float[Array, "n v"],
    T_world_camera: jaxlie.SE3,
    camera: Camera,
    config: RenderConfig,
) -> Rendering:
    """Draw `values` (colours, normals, features or one-hot labels) of the Gaussians with depth and coverage."""
    splats = splats_of(gaussians, T_world_camera, camera, config)
    return render_splats(splats, values, camera, config)


def splats_of(gaussians: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, config: RenderConfig) -> Splats:
    """The Gaussians on the image plane, as they are drawn."""
    return project_gaussians(gaussians, T_world_camera, camera, config.covariance_scale, config.blur)


def render_splats(splats: Splats, values: Float[Array, "n v"], camera: Camera, config: RenderConfig) -> Rendering:
    """`render` for Gaussians that are projected already."""
    sums, overflow = draw_tiles(splats, values, camera, config, composite)
    return rendering_of(*sums, overflow, config)


def draw_tiles(
    splats: Splats,
    values: Float[Array, "n v"],
    camera: Camera,
    config: RenderConfig,
    blend: Callable[..., PyTree[Array]],
) -> tuple[PyTree[Array], Int[Array, "t"]]:
    """Images (h, w, ...) of what `blend`, a function like `composite`, gives for the splats of every tile.

    Returns:
        The images, and how many splats found each tile full.
    """
    corners = tile_corners(camera, config.tile_size)
    rows, exists, overflow = assign_tiles(splats, corners, config.tile_size, config.tile_capacity, config.radius)
    step = jnp.arange(config.tile_size, dtype=jnp.float32)
    inside = jnp.stack(jnp.meshgrid(step, step, indexing="xy"), axis=-1).reshape(-1, 2)

    def draw(tile: Tile) -> PyTree[Array]:
        corner, tile_rows, tile_exists = tile
        near, near_values = take_rows((splats, values), tile_rows)
        near = eqx.tree_at(lambda s: s.valid, near, near.valid & tile_exists)
        near_values = jnp.where(near.valid[:, None], near_values, 0.0)
        return blend(near, near_values, corner + inside, config)

    tiles = _map_by_fill(draw, (corners, rows, exists), min(config.tile_batch, corners.shape[0]))
    return jax.tree.map(lambda x: _assemble(x, camera, config.tile_size), tiles), overflow


def _map_by_fill(draw: Callable[[Tile], PyTree[Array]], tiles: Tile, batch_size: int) -> PyTree[Array]:
    """Draw all tiles, equally full ones together, each batch with as few of its rows as the fullest tile needs.

    Args:
        draw: what one tile becomes; the splats that exist are its first rows.
        tiles: corners (t, 2), rows (t, c), which exist (t, c).
        batch_size: tiles at once; at most t.
    """
    capacity = tiles[1].shape[1]
    sizes = [-(-capacity // 2**power) for power in reversed(range(NUM_SIZES))]
    order = jnp.argsort(jnp.sum(tiles[2], axis=1))
    batches = jax.tree.map(lambda x: fill_rows(x[order], batch_size, 0).reshape(-1, batch_size, *x.shape[1:]), tiles)

    def first_rows(size: int) -> Callable[[Tile], PyTree[Array]]:
        return jax.vmap(lambda tile: draw((tile[0], tile[1][:size], tile[2][:size])))

    def draw_batch(batch: Tile) -> PyTree[Array]:
        fullest = jnp.max(jnp.sum(batch[2], axis=1))
        return jax.lax.switch(jnp.sum(fullest > jnp.array(sizes[:-1])), [first_rows(size) for size in sizes], batch)

    drawn = jax.lax.map(draw_batch, batches)
    back = jnp.argsort(order)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[back], drawn)


def rendering_of(
    values_sum: Float[Array, "h w v"],
    alpha: Float[Array, "h w"],
    depth_sum: Float[Array, "h w"],
    depth_sq_sum: Float[Array, "h w"],
    overflow: Int[Array, "t"],
    config: RenderConfig,
) -> Rendering:
    """The means behind the images of `composite`; `overflow` is of every tile."""
    is_covered = alpha >= jnp.maximum(config.min_alpha, 1e-6)
    total = jnp.where(is_covered, alpha, 1.0)
    depth = jnp.where(is_covered, depth_sum / total, 0.0)
    variance = jnp.maximum(depth_sq_sum / total - depth**2, 1e-12)
    depth_std = jnp.where(is_covered, jnp.sqrt(variance), 0.0)
    return Rendering(values_sum, alpha, depth, depth_std, _seen_overflow(overflow, alpha, config.tile_size))


def _seen_overflow(overflow: Int[Array, "t"], alpha: Float[Array, "h w"], tile_size: int) -> Int[Array, ""]:
    """The overflow of the tiles that have a pixel which is not opaque."""
    height, width = alpha.shape
    rows, columns = -(-height // tile_size), -(-width // tile_size)
    beyond = (0, rows * tile_size - height), (0, columns * tile_size - width)
    pixels = jnp.pad(alpha, beyond, constant_values=1.0).reshape(rows, tile_size, columns, tile_size)
    return jnp.sum(jnp.where(jnp.min(pixels, axis=(1, 3)).reshape(-1) < OPAQUE, overflow, 0))


def _assemble(tiles: Float[Array, "t q *c"], camera: Camera, tile_size: int) -> Float[Array, "h w *c"]:
    """Tiles in row-major order -> image, cut at the border."""
    columns, rows = -(-camera.width // tile_size), -(-camera.height // tile_size)
    channels = tiles.shape[2:]
    grid = tiles.reshape(rows, columns, tile_size, tile_size, *channels).swapaxes(1, 2)
    return grid.reshape(rows * tile_size, columns * tile_size, *channels)[: camera.height, : camera.width]
