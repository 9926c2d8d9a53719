"""Nearest neighbours and compaction with static shapes."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.k_smallest import smallest
from emgs_jax.ops.pytree import fill_rows, join_rows

GROUP = 32  # points per group: near each other
CURVE_BITS = 8  # per axis, of the cells of the Hilbert curve
# Queries at once. On a CPU they are near each other, and their distances stay in the cache.
BLOCK, LARGE_BLOCK = 64, 256
NUM_NEAR = 32  # groups that such a block looks at first, beside twice its share of all groups


def knn(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], valid: Bool[Array, "n"], k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """The k nearest valid points of every query, nearest first; exact up to `smallest`'s precision.

    Points and queries are sorted along the Hilbert curve, so that groups of points and blocks of queries are compact.
    On a CPU a block looks at the groups whose boxes are nearest to its own, then at the next ones as long as they might
    hold one of the k nearest; on an accelerator, which such a condition would hold up, it looks at all points.

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
    groups = fill_rows(sorted_points, GROUP, jnp.inf).reshape(-1, GROUP, points.shape[1])
    rows, exists = jax.lax.platform_dependent(
        queries[query_order],
        groups,
        cpu=lambda queries, groups: _by_blocks(queries, groups, BLOCK, NUM_NEAR, k),
        default=lambda queries, groups: _by_blocks(queries, groups, LARGE_BLOCK, groups.shape[0], k),
    )
    found = jnp.where(exists, order[rows], 0), exists
    return jax.tree.map(lambda sorted_rows: jnp.zeros_like(sorted_rows).at[query_order].set(sorted_rows), found)


def _by_blocks(
    queries: Float[Array, "m d"], groups: Float[Array, "g p d"], size: int, num_near: int, k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Neighbours of all queries, block after block, as rows of the flattened groups; free places are at infinity."""
    num_queries, num_axes = queries.shape
    blocks = jnp.pad(queries, ((0, -num_queries % size), (0, 0)), mode="edge").reshape(-1, size, num_axes)
    num_near = max(num_near + 2 * groups.shape[0] // blocks.shape[0], -(-k // GROUP))
    num_near = min(num_near, groups.shape[0])
    groups = fill_rows(groups, num_near, jnp.inf)
    turns = _by_distance(blocks, groups, num_near)
    found = jax.lax.map(lambda each: _search_block(*each, groups, k), (blocks, *turns))
    return join_rows(found, num_queries)


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


def _by_distance(
    blocks: Float[Array, "b q d"], groups: Float[Array, "g p d"], num_near: int
) -> tuple[Int[Array, "b t c"], Float[Array, "b t"]]:
    """The groups in the order of the distance between their boxes and each block's, in turns of `num_near`.

    Returns:
        The groups of every turn, and the squared distance of the nearest group after it.
    """
    if groups.shape[0] == num_near:
        one = (blocks.shape[0], 1)
        return jnp.broadcast_to(jnp.arange(num_near), (*one, num_near)), jnp.full(one, jnp.inf)
    low, high = jnp.min(groups, axis=1), jnp.max(jnp.where(jnp.isfinite(groups), groups, -jnp.inf), axis=1)
    block_low, block_high = (bound(blocks, axis=1)[:, None] for bound in (jnp.min, jnp.max))
    gaps = jnp.maximum(jnp.maximum(low - block_high, block_low - high), 0.0)
    gaps_sq = jnp.sum(gaps**2, axis=-1)
    order = smallest(gaps_sq.T, groups.shape[0]).T
    beyond_sq = jnp.take_along_axis(gaps_sq, order[:, num_near::num_near], axis=1)
    beyond_sq = jnp.pad(beyond_sq, ((0, 0), (0, 1)), constant_values=jnp.inf)
    return order.reshape(blocks.shape[0], -1, num_near), beyond_sq


def _search_block(
    queries: Float[Array, "q d"],
    turns: Int[Array, "t c"],
    beyond_sq: Float[Array, "t"],
    groups: Float[Array, "g p d"],
    k: int,
) -> tuple[Int[Array, "q k"], Bool[Array, "q k"]]:
    """Neighbours of one block: turn after turn, until no group beyond can hold a nearer point."""

    def look(turn: int | Int[Array, ""]) -> tuple[Int[Array, "k q"], Float[Array, "k q"]]:
        near = turns[turn]
        index, distance_sq = _search(queries, groups[near].reshape(-1, groups.shape[2]), k)
        return near[index // GROUP] * GROUP + index % GROUP, distance_sq

    def is_open(state: tuple) -> Bool[Array, ""]:
        turn, (_, distance_sq) = state
        return (turn + 1 < turns.shape[0]) & ~jnp.all(distance_sq[-1] <= beyond_sq[turn])

    def look_on(state: tuple) -> tuple:
        turn, found = state
        both = jax.tree.map(lambda old, new: jnp.concatenate([old, new]), found, look(turn + 1))
        best = smallest(both[1], k)
        return turn + 1, jax.tree.map(lambda rows: jnp.take_along_axis(rows, best, axis=0), both)

    found = look(0)
    if turns.shape[0] > 1:
        _, found = jax.lax.while_loop(is_open, look_on, (0, found))
    rows, distance_sq = found
    return rows.T, jnp.isfinite(distance_sq).T


def _search(
    queries: Float[Array, "q d"], points: Float[Array, "n d"], k: int
) -> tuple[Int[Array, "k q"], Float[Array, "k q"]]:
    """Rows of the k nearest of all points, nearest first, and their squared distances.

    Every one of the k nearest is in one of k sets of points whose nearest member is nearest, so only those sets are
    sorted: a minimum over sets is much cheaper than a partial sort of all distances.
    """
    num_sets = GROUP * max(-(-k // GROUP), math.isqrt(k * points.shape[0]) // GROUP, 1)
    points = fill_rows(points, num_sets, jnp.inf)
    members, columns = points.reshape(-1, num_sets, points.shape[1]), queries.T
    nearest_sq = jax.lax.platform_dependent(
        members,
        columns,
        cpu=_nearest_member_by_parts,
        default=lambda members, columns: jnp.min(_distance_sq(members[:, :, None], columns), axis=0),
    )
    sets = smallest(nearest_sq, k)
    candidates = _distance_sq(members[:, sets], columns).reshape(-1, queries.shape[0])
    best = smallest(candidates, k)
    rows = (best // k) * num_sets + jnp.take_along_axis(sets, best % k, axis=0)
    return rows, jnp.take_along_axis(candidates, best, axis=0)


def _nearest_member_by_parts(members: Float[Array, "m s d"], columns: Float[Array, "d q"]) -> Float[Array, "s q"]:
    """Squared distance from every query to the nearest member of each set.

    Part of the sets after part, member after member: XLA would share larger pieces among the processor's threads, which
    takes longer than the work, and would not fill the vectors in a reduction over the first axis.
    """

    def closer(least_sq: Float[Array, "p q"], points: Float[Array, "p d"]) -> tuple[Float[Array, "p q"], None]:
        return jnp.minimum(least_sq, _distance_sq(points[:, None], columns)), None

    start = jnp.full((GROUP, columns.shape[1]), jnp.inf)
    parts = members.reshape(members.shape[0], -1, GROUP, members.shape[2]).swapaxes(0, 1)
    return jax.lax.map(lambda part: jax.lax.scan(closer, start, part)[0], parts).reshape(-1, columns.shape[1])


def _distance_sq(points: Float[Array, "*#b d"], columns: Float[Array, "d q"]) -> Float[Array, "*b"]:
    # One axis after the other, and the queries last: so the sums fill the processor's vectors.
    return sum(((points[..., axis] - columns[axis]) ** 2 for axis in range(columns.shape[0])), start=jnp.zeros(()))


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
