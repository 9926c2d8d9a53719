"""Splats of each tile of the image: one list for all tiles, sorted by tile and depth (3DGS)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.camera import Camera
from emgs_jax.render.project import Splats

CHUNK = 32  # splats of a tile that are composited at once; a tile's last chunk may have fewer
WORD = 2**31  # range of an integer


class TileLists(eqx.Module):
    """The splats of every tile, nearest first, one tile after the other.

    Args:
        rows: of the splats; arbitrary past the last tile's list.
        bounds: start of every tile's list, and end of the last one.
        chunks: likewise in chunks of CHUNK splats.
        overflow: how many splats of every tile did not fit.
    """

    rows: Int[Array, "e"]
    bounds: Int[Array, "b"]
    chunks: Int[Array, "b"]
    overflow: Int[Array, "t"]


class Chunks(eqx.Module):
    """Some consecutive chunks of the lists.

    Args:
        tiles: to which they belong; past the last tile for empty slots.
        positions: in the lists.
        rows: of the splats; the first of the lists for empty slots.
    """

    tiles: Int[Array, "c"]
    positions: Int[Array, "c k"]
    rows: Int[Array, "c k"]
    exists: Bool[Array, "c k"]


def num_tiles(camera: Camera, tile_size: int) -> tuple[int, int]:
    """Count columns and rows of tiles; the last ones may extend beyond the border."""
    return -(-camera.width // tile_size), -(-camera.height // tile_size)


def tile_corners(camera: Camera, tile_size: int) -> Float[Array, "t 2"]:
    """Compute the pixel (x, y) of every tile's upper left corner, row-major."""
    x, y = (tile_size * jnp.arange(count, dtype=jnp.float32) for count in num_tiles(camera, tile_size))
    return jnp.stack(jnp.meshgrid(x, y, indexing="xy"), axis=-1).reshape(-1, 2)


def list_splats(splats: Splats, camera: Camera, tile_size: int, capacity: int, radius: Float[Array, ""]) -> TileLists:
    """List the splats whose bounding box of `radius` standard deviations meets a tile.

    As in Kerbl et al., "3D Gaussian Splatting", 2023, section 6: every splat is copied for each tile that it touches,
    the copies are sorted by tile and depth, and a tile's list is a range of them.

    Args:
        tile_size: pixels along a tile's side.
        capacity: splats per tile, on average over the tiles; the nearest of all come first.
        radius: standard deviations.
    """
    columns, lines = num_tiles(camera, tile_size)
    num_splats, num_lists = splats.depth.shape[0], columns * lines
    # Positive floats sort like their bits.
    depth = jax.lax.bitcast_convert_type(jnp.where(splats.valid, splats.depth, jnp.inf), jnp.int32)
    order = jnp.argsort(depth, stable=True)
    first, size = (x[order] for x in _touched(splats, jnp.array([columns, lines]), tile_size, radius))
    counts = size[:, 0] * size[:, 1]
    ends = jnp.cumsum(counts)

    copies = jnp.arange(num_lists * capacity)
    splat = jnp.cumsum(jnp.zeros(copies.shape, jnp.int32).at[ends].add(1, mode="drop"))  # how many end before
    splat = jnp.minimum(splat, num_splats - 1)
    number, width = copies - (ends - counts)[splat], jnp.maximum(size[splat, 0], 1)
    tile = (first[splat, 1] + number // width) * columns + first[splat, 0] + number % width
    tile, splat = _sorted(jnp.where(copies < ends[-1], tile, num_lists), splat, num_lists, num_splats)

    bounds = jnp.searchsorted(tile, jnp.arange(num_lists + 1))
    listed = jnp.diff(bounds)
    chunks = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(-(-listed // CHUNK))])
    return TileLists(order[splat], bounds, chunks, _num_touching(first, size, (lines, columns)) - listed)


def _touched(
    splats: Splats, num: Int[Array, "2"], tile_size: int, radius: Float[Array, ""]
) -> tuple[Int[Array, "n 2"], Int[Array, "n 2"]]:
    """Find the first tile (column, row) that every splat's box meets, and the box's width and height in tiles."""
    half = radius * jnp.sqrt(jnp.stack([splats.covs[:, 0, 0], splats.covs[:, 1, 1]], axis=-1))
    low, high = splats.means - half, splats.means + half
    first = jnp.clip(jnp.ceil((low - (tile_size - 1)) / tile_size), 0, num).astype(jnp.int32)
    last = jnp.clip(jnp.floor(high / tile_size) + 1, 0, num).astype(jnp.int32)
    is_drawn = splats.valid & jnp.all(high >= low, axis=-1)
    return first, jnp.where(is_drawn[:, None], jnp.maximum(last - first, 0), 0)


def _sorted(
    tile: Int[Array, "e"], splat: Int[Array, "e"], num_lists: int, num_splats: int
) -> tuple[Int[Array, "e"], Int[Array, "e"]]:
    """Sort pairs by tile, then by splat. If one word holds both, sorting it is several times faster."""
    if (num_lists + 1) * num_splats < WORD:
        return jnp.divmod(jax.lax.sort(tile * num_splats + splat, is_stable=False), num_splats)
    tile, splat = jax.lax.sort((tile, splat), num_keys=2, is_stable=False)
    return tile, splat


def _num_touching(first: Int[Array, "n 2"], size: Int[Array, "n 2"], shape: tuple[int, int]) -> Int[Array, "t"]:
    """Count the splats that touch every tile: boxes that begin minus boxes that ended, summed along both axes."""
    (x0, y0), (x1, y1) = first.T, (first + size).T
    changes = jnp.zeros((shape[0] + 1, shape[1] + 1), jnp.int32)
    changes = changes.at[y0, x0].add(1).at[y1, x1].add(1).at[y0, x1].add(-1).at[y1, x0].add(-1)
    return jnp.cumsum(jnp.cumsum(changes, axis=0), axis=1)[:-1, :-1].reshape(-1)


def take_chunks(lists: TileLists, begin: Int[Array, ""], count: int) -> Chunks:
    """Take `count` chunks of the lists, from chunk `begin` on."""
    last = lists.bounds.shape[0] - 2
    numbers = begin + jnp.arange(count)
    tiles = jnp.searchsorted(lists.chunks[1:], numbers, side="right")
    of = jnp.minimum(tiles, last)
    starts = lists.bounds[of] + (numbers - lists.chunks[of]) * CHUNK
    positions = starts[:, None] + jnp.arange(CHUNK)
    exists = positions < lists.bounds[of + 1][:, None]  # none past the last tile
    # The first row exists if any does, so empty slots hold finite values.
    return Chunks(tiles, positions, lists.rows[jnp.where(exists, positions, 0)], exists)
