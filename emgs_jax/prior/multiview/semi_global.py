"""Semi-global aggregation: neighbours agree on a plane unless the image has an edge (Hirschmüller, PAMI 2008)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emgs_jax.ops.pytree import traced


class SemiGlobalConfig(eqx.Module):
    """Penalties, in units of the matching cost."""

    small_step: Float[Array, "*b"] = traced(0.1, low=0)  # for a change by one plane along a path
    large_step: Float[Array, "*b"] = traced(1.0, low=0)  # for any larger change where the image is flat
    edge: Float[Array, "*b"] = traced(0.03, low=1e-6)  # grey value difference, in [0, 1], that halves `large_step`


def _advance(path: Array, cost: Array, large_step: Array, config: SemiGlobalConfig) -> Array:
    """Cost of the best path to every plane, minus the least cost of the pixel before, so that it stays bounded."""
    best = jnp.min(path, axis=-1, keepdims=True)
    beyond = jnp.full_like(best, jnp.inf)
    nearer = jnp.concatenate([path[..., 1:], beyond], axis=-1)
    farther = jnp.concatenate([beyond, path[..., :-1]], axis=-1)
    smooth = jnp.minimum(path, jnp.minimum(nearer, farther) + config.small_step)
    return cost + jnp.minimum(smooth, best + large_step[..., None]) - best


def _downwards(cost: Array, gray: Array, shifts: tuple[int, ...], config: SemiGlobalConfig) -> Array:
    """Sum (h, w, d) over the paths from the row above, straight or shifted by a column."""

    def step(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        paths, above = carry
        cost_row, gray_row = row
        moved = []
        for path, shift in zip(paths, shifts, strict=True):
            # At the border its own column is taken.
            before, light = (_shift(array, shift) for array in (path, above))
            penalty = config.large_step / (1.0 + jnp.abs(gray_row - light) / config.edge)
            penalty = jnp.maximum(penalty, config.small_step)
            moved.append(_advance(before, cost_row, penalty, config))
        paths = jnp.stack(moved)
        return (paths, gray_row), jnp.sum(paths, axis=0)

    start = jnp.zeros((len(shifts), *cost.shape[1:])), gray[0]
    return jax.lax.scan(step, start, (cost, gray))[1]


def _shift(array: Array, shift: int) -> Array:
    """Element i of the result is element i - shift."""
    if shift == 0:
        return array
    return jnp.concatenate([array[:1], array[:-1]]) if shift > 0 else jnp.concatenate([array[1:], array[-1:]])


def aggregate(
    cost: Float[Array, "h w d"], gray: Float[Array, "h w"], config: SemiGlobalConfig
) -> Float[Array, "h w d"]:
    """Mean over eight directions of the cost of the best path to each pixel and plane."""
    total = jnp.zeros_like(cost)
    for shifts, is_sideways in (((-1, 0, 1), False), ((0,), True)):
        view = jnp.swapaxes(cost, 0, 1) if is_sideways else cost
        image = gray.T if is_sideways else gray
        paths = _downwards(view, image, shifts, config)
        paths += _downwards(view[::-1], image[::-1], shifts, config)[::-1]
        total += jnp.swapaxes(paths, 0, 1) if is_sideways else paths
    return total / 8.0
