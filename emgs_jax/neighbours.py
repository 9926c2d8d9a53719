"""Nearest neighbours and compaction with static shapes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

BLOCK = 256  # queries at once: their distances to some thousand points stay in the processor's cache
GROUP = 32  # points per group of the two-level search below


def knn(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], valid: Bool[Array, "n"], k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """The k nearest valid points of every query, nearest first, by exact search.

    Every one of the k nearest is in one of the k groups whose nearest member is nearest, so only those groups are
    sorted: a maximum over groups is much cheaper than a partial sort of all distances.

    Args:
        queries: m positions.
        points: n positions.
        valid: which points count.
        k: number of neighbours, static; at most n.

    Returns:
        Row numbers into `points`, and which of them exist: False where fewer than k points are valid.
    """
    num_groups = -(-points.shape[0] // GROUP)
    padding = num_groups * GROUP - points.shape[0]
    # Distances from the points' centre: |q|² - 2 q·p + |p|² cancels badly far from the origin.
    num_valid = jnp.maximum(jnp.sum(valid), 1).astype(points.dtype)
    center = jnp.sum(jnp.where(valid[:, None], points, 0.0), axis=0) / num_valid
    targets = jnp.where(valid[:, None], points - center, 0.0)
    half_sq = jnp.where(valid, 0.5 * jnp.sum(targets * targets, axis=-1), jnp.inf)
    targets = jnp.pad(targets, ((0, padding), (0, 0)))
    half_sq = jnp.pad(half_sq, (0, padding), constant_values=jnp.inf)

    def nearest(query: Float[Array, "d"]) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
        # |q|² is the same for all points of one query, so it is left out of the comparison. Group g is column g.
        closeness = (targets @ (query - center) - half_sq).reshape(GROUP, num_groups)
        best_of_group = jnp.max(closeness, axis=0)
        if k == 1:
            groups = jnp.argmax(best_of_group)[None]  # much faster than top_k
        else:
            _, groups = jax.lax.top_k(best_of_group, min(k, num_groups))
        rows = groups + num_groups * jnp.arange(GROUP)[:, None]
        best, index = jax.lax.top_k(closeness[:, groups].reshape(-1), k)
        exists = jnp.isfinite(best)
        return jnp.where(exists, rows.reshape(-1)[index], 0), exists

    return jax.lax.map(nearest, queries, batch_size=min(BLOCK, queries.shape[0]))


def compact_rows(mask: Bool[Array, "n"], capacity: int) -> tuple[Int[Array, "c"], Bool[Array, "c"], Int[Array, ""]]:
    """Row numbers of the first `capacity` True entries, in order.

    Returns:
        The rows (n where there is none, which `put_rows` drops), which of them exist, and how many did not fit.
    """
    ranks = jnp.cumsum(mask)
    rows = jnp.searchsorted(ranks, jnp.arange(1, capacity + 1))
    exists = jnp.arange(capacity) < ranks[-1]
    overflow = jnp.maximum(ranks[-1] - capacity, 0)
    return jnp.where(exists, rows, mask.shape[0]), exists, overflow
