"""Front-to-back compositing of the tiles' splats, its gradient, and the image from all tiles."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int, PyTree

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, take_rows, traced
from emgs_jax.render.project import Splats, project_gaussians
from emgs_jax.render.tiles import CHUNK, Chunks, TileLists, list_splats, num_tiles, take_chunks, tile_corners

OPAQUE = 0.99  # coverage of a pixel beyond which farther splats change it by less than a hundredth
MAX_ALPHA = 0.999  # of the light that a splat may take from those behind it, so that a logarithm of the rest exists
ROUNDED = 2.0**-20  # of a depth: smallest standard deviation, by rounding
Sums: TypeAlias = tuple[Float[Array, "t v q"], Float[Array, "t q"], Float[Array, "t q"], Float[Array, "t q"]]
State = TypeVar("State")


class RenderConfig(eqx.Module):
    """Settings of the renderer: tiles, splats and coverage.

    Args:
        tile_size: pixels along a tile's side.
        tile_capacity: splats per tile, on average over the tiles; a single tile may hold more. About 12 bytes each. The
            nearest splats of the image come first; `Rendering.overflow` counts those that do not fit.
        tile_batch: chunks (of CHUNK splats) drawn at once. This bounds the memory to about six floats per splat and
            pixel of its tile.
        opacity: of every Gaussian at its centre (the paper's constant opacity).
        covariance_scale: factor on the covariances, so that neighbouring Gaussians close the surface.
        blur: pixels²; low-pass filter.
        radius: standard deviations beyond which a splat is not drawn.
        min_alpha: a pixel with less coverage has no depth.
    """

    tile_size: int = static(16, low=1, high=1024)
    tile_capacity: int = static(1024, low=1, high=2**20)
    tile_batch: int = static(256, low=1, high=2**20)
    opacity: Float[Array, "*b"] = traced(0.9, low=0, high=1)
    covariance_scale: Float[Array, "*b"] = traced(1.0, low=1e-6)
    blur: Float[Array, "*b"] = traced(0.3, low=0)
    radius: Float[Array, "*b"] = traced(3.0, low=0)
    min_alpha: Float[Array, "*b"] = traced(0.3, low=0, high=1)


class Rendering(eqx.Module):
    """Images of the map.

    Args:
        values: composited values, not divided by alpha; 0 where nothing is drawn.
        alpha: coverage in [0, 1].
        depth: expected camera-space z in metres; 0 where alpha is below `min_alpha`.
        depth_std: standard deviation in metres of the depth over the splats of a pixel; large where two surfaces mix.
        overflow: splats that did not fit, summed over the tiles that are not fully opaque; in the others they would be
            hidden anyway.
    """

    values: Float[Array, "h w c"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    depth_std: Float[Array, "h w"]
    overflow: Int[Array, ""]


def splat_alpha(splats: Splats, pixels: Float[Array, "*p q 2"], config: RenderConfig) -> Float[Array, "*c q"]:
    """Compute each splat's opacity at every pixel: opacity · exp(-½ d²) up to `MAX_ALPHA`; 0 beyond `radius`."""
    dx, dy = _offsets(splats, pixels)
    a, b, c = (splats.precisions[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    distance_sq = a * dx**2 + 2.0 * b * dx * dy + c * dy**2
    opacity = config.opacity * splats.opacity[..., None]
    alpha = jnp.minimum(opacity * jnp.exp(-0.5 * distance_sq), MAX_ALPHA)
    return jnp.where(distance_sq <= config.radius**2, alpha, 0.0)


def splat_depth(splats: Splats, pixels: Float[Array, "*p q 2"], config: RenderConfig) -> Float[Array, "*c q"]:
    """Compute camera-space z of every splat's plane at every pixel, limited to the splat's extent in depth."""
    dx, dy = _offsets(splats, pixels)
    slope = splats.depth_slope[..., None]
    inverse = splats.inverse_depth[..., None] + slope[..., 0, :] * dx + slope[..., 1, :] * dy
    reach = config.radius * splats.depth_std
    nearest, farthest = splats.depth - reach, splats.depth + reach
    highest = 1.0 / jnp.maximum(nearest, 0.1 * splats.depth)
    return 1.0 / jnp.clip(inverse, (1.0 / farthest)[..., None], highest[..., None])


def _offsets(splats: Splats, pixels: Float[Array, "*p q 2"]) -> tuple[Float[Array, "*c q"], Float[Array, "*c q"]]:
    """Compute the x and y offsets of every pixel from every splat's mean."""
    return pixels[..., 0] - splats.means[..., 0, None], pixels[..., 1] - splats.means[..., 1, None]


def at_pixels(
    splats: Splats, chunks: Chunks, pixels: Float[Array, "t q 2"], config: RenderConfig
) -> tuple[Float[Array, "c k q"], Float[Array, "c k q"]]:
    """Compute opacity of the chunks' splats at their tiles' pixels, and depth; 0 where the opacity is 0."""
    near = take_rows(splats, chunks.rows)
    seen = take_rows(pixels, chunks.tiles)[:, None]
    alpha = jnp.where(chunks.exists[..., None], splat_alpha(near, seen, config), 0.0)
    return alpha, jnp.where(alpha > 0, splat_depth(near, seen, config), 0.0)


def _sum_before(
    terms: Float[Array, "c k q"], chunks: Chunks, total: Float[Array, "t q"]
) -> tuple[Float[Array, "c k q"], Float[Array, "t q"]]:
    """Sum the terms that come before each one in its tile's list, and all terms so far.

    Args:
        terms: of the splats of some chunks.
        chunks: these chunks.
        total: sum over the earlier chunks; the second result includes these.
    """
    count, length, _ = terms.shape
    # Products with triangles of ones: `cumsum` takes several passes on every device, and 20 times as long on a CPU.
    triangle = jnp.broadcast_to(jnp.tri(length, k=-1), (count, length, length))
    within = jnp.einsum("ckl,clq->ckq", triangle, terms)
    whole = within[:, -1] + terms[:, -1]
    is_same = chunks.tiles[:, None] == chunks.tiles
    earlier = jnp.where(is_same, jnp.tri(count, k=-1), 0.0) @ whole
    before = within + (take_rows(total, chunks.tiles) + earlier)[:, None]
    return before, total.at[chunks.tiles].add(whole, mode="drop")


def light_before(
    alpha: Float[Array, "c k q"], chunks: Chunks, log_light: Float[Array, "t q"]
) -> tuple[Float[Array, "c k q"], Float[Array, "t q"]]:
    """Compute the light that reaches every splat of some chunks, and the log of what remains behind them."""
    before, log_light = _sum_before(jnp.log(1.0 - alpha), chunks, log_light)
    return jnp.exp(before), log_light


def _add(sums: Sums, chunks: Chunks, weights: Float[Array, "c k q"], depth: Array, values: Array) -> Sums:
    """Add the splats of some chunks to the sums."""
    # Sum by products with ones: a reduction uses one thread on a CPU.
    ones = jnp.ones((*weights.shape[:2], 1))
    moments = (jnp.einsum("cko,ckq->cq", ones, weights * depth**power) for power in range(3))
    more = jnp.einsum("ckv,ckq->cvq", values[chunks.rows], weights), *moments
    return jax.tree.map(lambda x, y: x.at[chunks.tiles].add(y, mode="drop"), sums, more)


def over_chunks(visit: Callable[[Chunks, State], State], start: State, lists: TileLists, config: RenderConfig) -> State:
    """Visit all chunks of the lists, `tile_batch` at a time."""
    count = min(config.tile_batch, lists.rows.shape[0] // CHUNK + lists.overflow.shape[0])

    def step(turn: Int[Array, ""], state: State) -> State:
        return visit(take_chunks(lists, turn * count, count), state)

    return jax.lax.fori_loop(0, -(-lists.chunks[-1] // count), step, start)


@eqx.filter_custom_vjp
def composite(
    drawn: tuple[Splats, Float[Array, "n v"], RenderConfig],
    lists: TileLists,
    pixels: Float[Array, "t q 2"],
    front: tuple[Float[Array, "t q"], Float[Array, "t q"]] | None,
) -> Sums:
    """Blend the splats of every tile, nearest first: Σ w v, Σ w, Σ w z and Σ w z² of every pixel.

    The weight of a splat is its opacity times the light that nearer splats let through. With a `front` it is the
    opacity alone, of splats whose depth lies between the two values (m).
    """
    splats, values, config = drawn

    def visit(chunks: Chunks, state: tuple[Sums, Array]) -> tuple[Sums, Array]:
        sums, log_light = state
        alpha, depth = at_pixels(splats, chunks, pixels, config)
        share, log_light = _share(alpha, depth, chunks, log_light, front)
        return _add(sums, chunks, alpha * share, depth, values), log_light

    dark = jnp.zeros(pixels.shape[:2])
    start = (jnp.zeros((dark.shape[0], values.shape[1], dark.shape[1])), dark, dark, dark), dark
    return over_chunks(visit, start, lists, config)[0]


def _share(
    alpha: Float[Array, "c k q"], depth: Float[Array, "c k q"], chunks: Chunks, log_light: Array, front: Any
) -> tuple[Float[Array, "c k q"], Float[Array, "t q"]]:
    """Compute the factor from opacity to weight of every splat, and the log of the light behind these chunks."""
    if front is None:
        return light_before(alpha, chunks, log_light)
    low, high = (take_rows(x, chunks.tiles)[:, None] for x in front)
    return jnp.where((depth >= low) & (depth <= high), 1.0, 0.0), log_light


@composite.def_fwd
def _composite_forward(_, drawn: Any, lists: TileLists, pixels: Array, front: Any) -> tuple[Sums, Sums]:
    sums = composite(drawn, lists, pixels, front)
    return sums, sums


@composite.def_bwd
@full_precision
def _composite_backward(
    sums: Sums, slopes: Any, _, drawn: Any, lists: TileLists, pixels: Array, front: Any
) -> PyTree[Array]:
    """Visit the chunks a second time, so that nothing need be stored, as 3DGS does.

    Let g be the derivative of the result by a splat's weight w = α T. Its derivative by the opacity is T g minus what
    the splat takes from those behind it, Σ w g / (1 - α).
    """
    splats, values, config = drawn
    slopes = jax.tree.map(lambda x, y: jnp.zeros_like(x) if y is None else y, sums, slopes)
    by_value, *by_rest = slopes
    whole = jnp.sum(by_value * sums[0], axis=1) + sum(x * y for x, y in zip(by_rest, sums[1:], strict=True))

    def visit(chunks: Chunks, state: PyTree[Array]) -> PyTree[Array]:
        gradient, log_light, so_far = state
        (alpha, depth), pull = eqx.filter_vjp(lambda s, c: at_pixels(s, chunks, pixels, c), splats, config)
        share, log_light = _share(alpha, depth, chunks, log_light, front)
        weights = alpha * share
        per_value = take_rows(by_value, chunks.tiles)
        one, z, z_sq = (take_rows(x, chunks.tiles)[:, None] for x in by_rest)
        slope = jnp.einsum("ckv,cvq->ckq", values[chunks.rows], per_value) + one + z * depth + z_sq * depth**2
        by_alpha = share * slope
        if front is None:
            before, so_far = _sum_before(weights * slope, chunks, so_far)
            behind = take_rows(whole, chunks.tiles)[:, None] - before - weights * slope
            by_alpha -= behind / (1.0 - alpha)
        by_splats, by_config = pull((by_alpha, weights * (z + 2.0 * z_sq * depth)))
        by_values = jnp.where(chunks.exists[..., None], jnp.einsum("ckq,cvq->ckv", weights, per_value), 0.0)
        more = by_splats, jnp.zeros_like(values).at[chunks.rows].add(by_values), by_config
        return jax.tree.map(jnp.add, gradient, more), log_light, so_far

    none = jax.tree.map(jnp.zeros_like, eqx.filter(drawn, eqx.is_inexact_array))
    dark = jnp.zeros(pixels.shape[:2])
    return over_chunks(visit, (none, dark, dark), lists, config)[0]


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
    """Project the Gaussians to the image plane as `render` draws them."""
    return project_gaussians(gaussians, T_world_camera, camera, config.covariance_scale, config.blur)


def render_splats(splats: Splats, values: Float[Array, "n v"], camera: Camera, config: RenderConfig) -> Rendering:
    """Render projected Gaussians."""
    lists, pixels = lists_of(splats, camera, config)
    return rendering_of(composite((splats, values, config), lists, pixels, None), lists, camera, config)


def lists_of(splats: Splats, camera: Camera, config: RenderConfig) -> tuple[TileLists, Float[Array, "t q 2"]]:
    """List the splats of every tile, and its pixels, row-major."""
    step = jnp.arange(config.tile_size, dtype=jnp.float32)
    inside = jnp.stack(jnp.meshgrid(step, step, indexing="xy"), axis=-1).reshape(-1, 2)
    pixels = tile_corners(camera, config.tile_size)[:, None] + inside
    splats, radius = jax.lax.stop_gradient((splats, config.radius))  # the lists have no gradient
    return list_splats(splats, camera, config.tile_size, config.tile_capacity, radius), pixels


def rendering_of(sums: Sums, lists: TileLists, camera: Camera, config: RenderConfig) -> Rendering:
    """Turn the sums of `composite` into images of the tiles: values, coverage, depth and its deviation."""
    values, alpha, depth_sum, depth_sq_sum = images_of(sums, camera, config)
    is_covered = alpha >= jnp.maximum(config.min_alpha, 1e-6)
    total = jnp.where(is_covered, alpha, 1.0)
    depth = jnp.where(is_covered, depth_sum / total, 0.0)
    least = (ROUNDED * depth) ** 2
    variance = jnp.where(is_covered, jnp.maximum(depth_sq_sum / total - depth**2, least), 1.0)
    depth_std = jnp.where(is_covered, jnp.sqrt(variance), 0.0)
    return Rendering(values, alpha, depth, depth_std, _seen_overflow(lists.overflow, alpha, config.tile_size))


def _seen_overflow(overflow: Int[Array, "t"], alpha: Float[Array, "h w"], tile_size: int) -> Int[Array, ""]:
    """Sum the overflow of tiles that have a pixel which is not opaque."""
    height, width = alpha.shape
    rows, columns = -(-height // tile_size), -(-width // tile_size)
    beyond = (0, rows * tile_size - height), (0, columns * tile_size - width)
    pixels = jnp.pad(alpha, beyond, constant_values=1.0).reshape(rows, tile_size, columns, tile_size)
    return jnp.sum(jnp.where(jnp.min(pixels, axis=(1, 3)).reshape(-1) < OPAQUE, overflow, 0))


def images_of(sums: Sums, camera: Camera, config: RenderConfig) -> tuple[Float[Array, "h w *v"], ...]:
    """Assemble values (h, w, v), coverage, depth and its deviation (h, w) from all tiles."""
    values, *others = sums
    tiles = values.swapaxes(1, 2), *others
    return tuple(_assemble(x, camera, config.tile_size) for x in tiles)


def _assemble(tiles: Float[Array, "t q *c"], camera: Camera, tile_size: int) -> Float[Array, "h w *c"]:
    """Assemble tiles in row-major order into an image, cropped at the border."""
    columns, rows = num_tiles(camera, tile_size)
    channels = tiles.shape[2:]
    grid = tiles.reshape(rows, columns, tile_size, tile_size, *channels).swapaxes(1, 2)
    return grid.reshape(rows * tile_size, columns * tile_size, *channels)[: camera.height, : camera.width]
