"""Nearest neighbours and compaction with static shapes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

GROUP = 32  # points per group: near each other
CURVE_BITS = 8  # per axis, of the cells of the Hilbert curve
# Queries at once. On a CPU they are near each other, and their distances stay in the cache.
BLOCK, LARGE_BLOCK = 64, 256
NUM_NEAR = 32  # groups that such a block looks at first, beside twice its share of all groups


def knn(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], valid: Bool[Array, "n"], k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """The k nearest valid points of every query, nearest first, by exact search.

    Points and queries are sorted along the Hilbert curve, so that groups of points and blocks of queries are compact.
    On a CPU a block looks at the groups whose boxes are nearest to its own; where another group might hold one of the
    k nearest, and on an accelerator, which such a condition would hold up, it looks at all points.

    Args:
        queries: m positions.
        points: n positions.
        valid: which points count.
        k: number of neighbours, static; at most n.

    Returns:
        Row numbers into `points`, and which of them exist: False where fewer than k points are valid.
    """
    queries, points = jax.lax.stop_gradient((queries, points))  # a row number has no gradient
    low = jnp.min(jnp.where(valid[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(valid[:, None], points, -jnp.inf), axis=0)
    order = jnp.argsort(jnp.where(valid, _curve(points, low, high), jnp.iinfo(jnp.int32).max))
    query_order = jnp.argsort(_curve(queries, low, high))
    sorted_points = jnp.where(valid[:, None], points, jnp.inf)[order]
    padding = ((0, -points.shape[0] % GROUP), (0, 0))
    groups = jnp.pad(sorted_points, padding, constant_values=jnp.inf).reshape(-1, GROUP, points.shape[1])
    rows, exists = jax.lax.platform_dependent(
        queries[query_order],
        groups,
        cpu=lambda queries, groups: _by_blocks(queries, groups, BLOCK, NUM_NEAR, k),
        default=lambda queries, groups: _by_blocks(queries, groups, LARGE_BLOCK, groups.shape[0], k),
    )
    back = jnp.argsort(query_order)
    rows, exists = rows[back], exists[back]
    return jnp.where(exists, order[jnp.where(exists, rows, 0)], 0), exists


def _by_blocks(
    queries: Float[Array, "m d"], groups: Float[Array, "g p d"], size: int, num_near: int, k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Neighbours of all queries, block after block, as rows of the flattened groups; free places are at infinity."""
    num_queries, num_axes = queries.shape
    blocks = jnp.pad(queries, ((0, -num_queries % size), (0, 0)), mode="edge").reshape(-1, size, num_axes)
    boxes = jnp.min(groups, axis=1), jnp.max(jnp.where(jnp.isfinite(groups), groups, -jnp.inf), axis=1)
    num_near += 2 * groups.shape[0] // blocks.shape[0]
    if groups.shape[0] <= num_near or k > num_near * GROUP:
        found = jax.lax.map(lambda block: _search_all(block, groups, k), blocks)
    else:
        found = jax.lax.map(lambda block: _search_near(block, groups, boxes, num_near, k), blocks)
    return jax.tree.map(lambda rows: rows.reshape(-1, k)[:num_queries], found)


def _curve(positions: Float[Array, "m d"], low: Float[Array, "d"], high: Float[Array, "d"]) -> Int[Array, "m"]:
    """Number of every position's cell along the Hilbert curve through the box; outside of it, the nearest cell's.

    Source: Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707, 2004. Consecutive cells touch, so that
    groups are compact: a search takes an eighth less time than along the Z curve.
    """
    size = jnp.max(high - low)
    scaled = (positions - low) * (2**CURVE_BITS / jnp.where((size > 0) & jnp.isfinite(size), size, 1.0))
    cells = jnp.clip(jnp.where(jnp.isfinite(scaled), scaled, 0.0), 0, 2**CURVE_BITS - 1).astype(jnp.int32)
    axes = list(jnp.unstack(cells, axis=1))
    for bit in range(CURVE_BITS - 1, 0, -1):  # undo the turns of every cube, from the largest on
        lower = (1 << bit) - 1
        for number, axis in enumerate(axes):
            is_upper = (axis >> bit) & 1 > 0
            swapped = (axes[0] ^ axis) & lower
            axes[number] = jnp.where(is_upper, axis, axis ^ swapped)
            axes[0] = jnp.where(is_upper, axes[0] ^ lower, axes[0] ^ swapped)
    for number in range(1, len(axes)):  # Gray code
        axes[number] ^= axes[number - 1]
    flips = jnp.zeros_like(axes[0])
    for bit in range(CURVE_BITS - 1, 0, -1):
        flips ^= jnp.where((axes[-1] >> bit) & 1 > 0, (1 << bit) - 1, 0)
    code = jnp.zeros_like(flips)
    for bit in range(CURVE_BITS - 1, -1, -1):
        for axis in axes:
            code = (code << 1) | (((axis ^ flips) >> bit) & 1)
    return code


def _search_near(
    queries: Float[Array, "q d"],
    groups: Float[Array, "g p d"],
    boxes: tuple[Float[Array, "g d"], Float[Array, "g d"]],
    num_near: int,
    k: int,
) -> tuple[Int[Array, "q k"], Bool[Array, "q k"]]:
    """Neighbours of one block, as rows of the flattened groups; free places of a group are at infinity."""
    low, high = boxes
    gap = jnp.maximum(jnp.maximum(low - jnp.max(queries, axis=0), jnp.min(queries, axis=0) - high), 0.0)
    bounds, chosen = jax.lax.top_k(-jnp.sum(gap**2, axis=-1), num_near + 1)
    near = groups[chosen[:num_near]].reshape(-1, groups.shape[2])
    distance_sq = _distance_sq(queries[:, None], near)
    best, index = _smallest(distance_sq, k)
    rows = chosen[index // GROUP] * GROUP + index % GROUP
    is_exact = jnp.all(best[:, -1] <= -bounds[num_near])
    return jax.lax.cond(is_exact, lambda: (rows, jnp.isfinite(best)), lambda: _search_all(queries, groups, k))


def _search_all(
    queries: Float[Array, "q d"], groups: Float[Array, "g p d"], k: int
) -> tuple[Int[Array, "q k"], Bool[Array, "q k"]]:
    """The same among all points.

    Every one of the k nearest is in one of k sets of points whose nearest member is nearest, so only those sets are
    sorted: a minimum over sets is much cheaper than a partial sort of all distances.
    """
    points = groups.reshape(-1, groups.shape[2])
    is_point, num_sets = jnp.isfinite(points[:, 0]), groups.shape[0]
    # |q|² is the same for all points of one query. From the block's centre |p|² - 2 q·p cancels little; a query far
    # from all points, or none at all, must not move it.
    low = jnp.min(jnp.where(is_point[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(is_point[:, None], points, -jnp.inf), axis=0)
    center = jnp.nanmean(jnp.clip(queries, low, high), axis=0)
    offsets = jnp.where(is_point[:, None], points - center, 0.0)
    farness = jnp.where(is_point, jnp.sum(offsets**2, axis=-1), jnp.inf) - 2.0 * (queries - center) @ offsets.T
    _, sets = _smallest(jnp.min(farness.reshape(-1, GROUP, num_sets), axis=1), min(k, num_sets))
    near = points.reshape(GROUP, num_sets, -1)[:, sets].swapaxes(0, 1)
    distance_sq = _distance_sq(queries[:, None, None], near).reshape(queries.shape[0], -1)
    best, index = _smallest(distance_sq, k)
    member, chosen = jnp.divmod(index, sets.shape[1])
    return member * num_sets + jnp.take_along_axis(sets, chosen, axis=1), jnp.isfinite(best)


def _distance_sq(queries: Float[Array, "*#b d"], points: Float[Array, "*#b d"]) -> Float[Array, "*b"]:
    # One axis after the other: a sum over a last axis of three does not fill the processor's vectors.
    return sum((queries[..., axis] - points[..., axis]) ** 2 for axis in range(queries.shape[-1]))


def _smallest(values: Float[Array, "q c"], k: int) -> tuple[Float[Array, "q k"], Int[Array, "q k"]]:
    """The k smallest of every row, ascending, and where they are."""
    negative, index = jax.lax.top_k(-values, k)
    return -negative, index


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
