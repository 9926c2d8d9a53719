"""Plane sweep: the matching cost of each inverse depth of a pixel in other images (Collins, CVPR 1996)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, pixel_grid, rays
from emgs_jax.ops.pytree import static, traced
from emgs_jax.prior.sources import Sources


class SweepConfig(eqx.Module):
    """Planes and the matching cost."""

    num_planes: int = static(64, low=2, high=4096)  # inverse depths that are tried
    num_best: int = static(2, low=1, high=64)  # sources that confirm a plane; the others may not see the point
    census_radius: int = static(4, low=1, high=32)  # half the side of the compared window
    census_spacing: int = static(2, low=1, high=32)  # between the window's rows and columns in use
    census_margin: Float[Array, "*b"] = traced(0.01, low=0, high=1)  # difference of equal grey values, in [0, 1]
    unseen_cost: Float[Array, "*b"] = traced(0.5, low=0)  # outside of a source's image; a random match costs about .5

    def __check_init__(self) -> None:
        if len(_taps(self)) > 32:
            raise ValueError("census_radius and census_spacing give more than 32 comparisons; choose a larger spacing")


def _taps(config: SweepConfig) -> list[tuple[int, int]]:
    steps = range(-config.census_radius, config.census_radius + 1, config.census_spacing)
    return [(dy, dx) for dy in steps for dx in steps if (dy, dx) != (0, 0)]


def census(gray: Float[Array, "h w"], config: SweepConfig, scale: int = 1) -> UInt32[Array, "h w"]:
    """Census transform (Zabih and Woodfill, ECCV 1994): a bit for each brighter neighbour, spaced `scale` times."""
    reach = scale * config.census_radius
    height, width = gray.shape
    padded = jnp.pad(gray, reach, mode="edge")
    code = jnp.zeros(gray.shape, jnp.uint32)
    for bit, (dy, dx) in enumerate(_taps(config)):
        row, column = reach + scale * dy, reach + scale * dx
        other = jax.lax.dynamic_slice(padded, (row, column), (height, width))
        code |= (other > gray + config.census_margin).astype(jnp.uint32) << bit
    return code


def _double(gray: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """Double the resolution: pixel (2y, 2x) is pixel (y, x), those between are means."""

    def along(image: Array) -> Array:
        following = jnp.concatenate([image[1:], image[-1:]])
        return jnp.stack([image, 0.5 * (image + following)], axis=1).reshape(2 * image.shape[0], *image.shape[1:])

    return along(along(gray).T).T


def inverse_depths(near: Float[Array, ""], far: Float[Array, ""], config: SweepConfig) -> Float[Array, "d"]:
    """The planes, uniform in 1/z (1/m), from far to near."""
    return jnp.linspace(1.0 / far, 1.0 / near, config.num_planes)


def smallest(values: Float[Array, "s h w"], count: int) -> Float[Array, "k h w"]:
    """The `count` smallest values of each pixel in order, by exchanges: a tenth of the cost of a sort."""
    rows = list(values)
    count = min(count, len(rows))
    for done in range(count):
        for row in range(len(rows) - 1, done, -1):
            rows[row - 1], rows[row] = jnp.minimum(rows[row - 1], rows[row]), jnp.maximum(rows[row - 1], rows[row])
    return jnp.stack(rows[:count])


def sweep(
    gray: Float[Array, "h w"], sources: Sources, planes: Float[Array, "d"], camera: Camera, config: SweepConfig
) -> Float[Array, "h w d"]:
    """Matching cost of every plane (inverse depth) at every pixel, from 0 (all comparisons agree) to 1.

    Images are in [0, 1]. The codes of the sources are looked up at half a pixel's resolution, without interpolation.
    Sources and coordinates are taken one by one: all at once they take four times as long on a CPU.
    """
    reference = census(gray, config)
    codes = [census(_double(image), config, scale=2) for image in sources.views]
    num_taps, (height, width) = len(_taps(config)), codes[0].shape
    rotations, translations = sources.T_source_view.rotation().as_matrix(), sources.T_source_view.translation()
    directions = jnp.einsum("sij,hwj->sihw", rotations, rays(camera, pixel_grid(camera)))

    def source_cost(plane: Array, source: int) -> Array:
        # Homogeneous: the point of a plane at infinity is a direction.
        x, y, z = (directions[source, axis] + plane * translations[source, axis] for axis in range(3))
        divisor = jnp.where(z > NEAREST_DEPTH, z, 1.0)
        column, row = (
            jnp.round(2.0 * (camera.focal[axis] * along / divisor + camera.center[axis]))
            for axis, along in enumerate((x, y))
        )
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = (jnp.where(inside, value, 0.0).astype(jnp.int32) for value in (column, row))
        code = codes[source].reshape(-1)[row * width + column]
        differing = jax.lax.population_count(code ^ reference).astype(jnp.float32)
        is_seen = inside & (z > 0) & sources.is_used[source]
        return jnp.where(is_seen, differing / num_taps, config.unseen_cost)

    def plane_cost(plane: Array) -> Array:
        costs = jnp.stack([source_cost(plane, source) for source in range(len(codes))])
        return jnp.mean(smallest(costs, config.num_best), axis=0)

    return jnp.moveaxis(jax.lax.map(plane_cost, planes), 0, -1)
