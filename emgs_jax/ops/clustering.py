"""k-means with static shapes and without randomness: the seeds are evenly chosen points."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.linalg import between, dot
from emgs_jax.ops.neighbours import compact_rows, group_points, nearby
from emgs_jax.ops.pytree import take_rows

BLOCK = 16  # points that share a list of seeds
NUM_CANDIDATES = 24  # seeds near a block, among which each point finds its own while they move


def morton_order(height: int, width: int) -> Int[Array, "{height}*{width}"]:  # noqa: F821 (of the arguments)
    """Order row-major pixel numbers along the Z curve, so that every n-th of them is spread evenly over the image."""
    y, x = jnp.divmod(jnp.arange(height * width), width)
    code = jnp.zeros_like(x)
    for bit in range(max(height, width).bit_length()):
        code |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return jnp.argsort(code)


def strided_seeds(
    valid: Bool[Array, "m"], order: Int[Array, "m"], spacing: int, num_seeds: int
) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
    """Choose every `spacing`-th valid point along `order` as a seed; return rows, and which exist."""
    along, _, _ = compact_rows(valid[order], order.shape[0])  # positions of the valid points along the order
    count = jnp.sum(valid)
    wanted = spacing // 2 + spacing * jnp.arange(num_seeds)
    exists = wanted < count
    # Fewer points than half a spacing still give one seed.
    first = jnp.clip(count - 1, 0, wanted[0])
    wanted, exists = wanted.at[0].set(first), exists.at[0].set(count > 0)
    positions = along[jnp.where(exists, wanted, 0)]
    return order[jnp.minimum(positions, order.shape[0] - 1)], exists


def kmeans(
    points: Float[Array, "m 3"],
    valid: Bool[Array, "m"],
    seeds: Float[Array, "k 3"],
    seed_exists: Bool[Array, "k"],
    num_iterations: int,
) -> tuple[Float[Array, "k 3"], Bool[Array, "k"], Float[Array, "k"]]:
    """Cluster points by Lloyd's algorithm with a fixed number of iterations.

    Returns:
        Centroids, which of them have points, and how many; an empty cluster stays in place and becomes invalid.
    """
    near = nearby(points, valid, group_points(seeds, seed_exists), NUM_CANDIDATES, BLOCK)
    blocks, counts = take_rows((points, valid), near.queries)
    counts &= near.queries < points.shape[0]

    def iterate(_: Int[Array, ""], state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        centroids, exists, _ = state
        # Sum offsets, not positions: sums of many coordinates lose digits in float32.
        offsets = between(blocks, centroids[near.rows])
        distance_sq = jnp.where((near.exists & exists[near.rows])[:, None], dot(offsets, offsets), jnp.inf)
        nearest = jnp.argmin(distance_sq, axis=-1)[..., None]
        is_own = counts[..., None] & (nearest == jnp.arange(near.rows.shape[1]))
        sums = [jnp.sum(jnp.where(is_own, values, 0.0), axis=1) for values in (*offsets, jnp.ones(()))]
        sums = jnp.stack(sums, axis=-1)
        total = jnp.zeros((seeds.shape[0], 4)).at[near.rows].add(sums)
        count = total[:, 3]
        return centroids + total[:, :3] / jnp.maximum(count, 1.0)[:, None], exists & (count > 0), count

    start = seeds, seed_exists, seed_exists.astype(seeds.dtype)
    if num_iterations == 0:  # the seeds, each with its nearest points
        return seeds, *iterate(jnp.zeros((), jnp.int32), start)[1:]
    return jax.lax.fori_loop(0, num_iterations, iterate, start)
