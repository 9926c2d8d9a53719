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
    queries: Float[Array, "m d"],
    points: Float[Array, "n d"],
    valid: Bool[Array, "n"],
    k: int,
    asked: Bool[Array, "m"] | None = None,
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
        asked: queries that need an answer, None for all; on a CPU the others cost next to nothing.

    Returns:
        Row numbers into `points`, and which of them exist: False where fewer than k points are valid. A query that is
        not asked may have any or none.
    """
    queries, points = jax.lax.stop_gradient((queries, points))  # a row number has no gradient
    low = jnp.min(jnp.where(valid[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(valid[:, None], points, -jnp.inf), axis=0)
    cells = _curve(jnp.concatenate([points, queries]), low, high)
    order = jnp.argsort(jnp.where(valid, cells[: points.shape[0]], jnp.iinfo(jnp.int32).max))
    asked = jnp.ones(queries.shape[0], bool) if asked is None else asked
    query_order = jnp.argsort(jnp.where(asked, cells[points.shape[0] :], jnp.iinfo(jnp.int32).max))
    sorted_points = jnp.where(valid[:, None], points, jnp.inf)[order]
    groups = fill_rows(sorted_points, GROUP, jnp.inf).reshape(-1, GROUP, points.shape[1])
    # Those that are not asked come last; wherever they are, they must not widen the box of a block.
    sorted_queries = jnp.where(asked[:, None], queries, queries[query_order[0]])[query_order]
    rows, exists = jax.lax.platform_dependent(
        sorted_queries,
        asked[query_order],
        groups,
        cpu=lambda queries, asked, groups: _by_blocks(queries, asked, groups, BLOCK, NUM_NEAR, k),
        default=lambda queries, asked, groups: _by_blocks(queries, asked, groups, LARGE_BLOCK, groups.shape[0], k),
    )
    found = jnp.where(exists, order[rows], 0), exists
    return jax.tree.map(lambda sorted_rows: jnp.zeros_like(sorted_rows).at[query_order].set(sorted_rows), found)


def _by_blocks(
    queries: Float[Array, "m d"],
    asked: Bool[Array, "m"],
    groups: Float[Array, "g p d"],
    size: int,
    num_near: int,
    k: int,
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Neighbours of all queries, block after block, as rows of the flattened groups; free places are at infinity."""
    num_queries, num_axes = queries.shape
    blocks = jnp.pad(queries, ((0, -num_queries % size), (0, 0)), mode="edge").reshape(-1, size, num_axes)
    is_asked = jnp.any(fill_rows(asked, size, False).reshape(-1, size), axis=1)
    num_near = max(num_near + 2 * groups.shape[0] // blocks.shape[0], -(-k // GROUP))
    if num_near < groups.shape[0]:
        boxes = jnp.min(groups, axis=1), jnp.max(jnp.where(jnp.isfinite(groups), groups, -jnp.inf), axis=1)
        search = lambda block: _search_near(*block, groups, boxes, num_near, k)  # noqa: E731
    else:
        search = lambda block: _search(block[0], groups.reshape(-1, num_axes), k)  # noqa: E731
    rows, distance_sq = jax.lax.map(search, (blocks, is_asked))
    found = rows.swapaxes(1, 2), jnp.isfinite(distance_sq).swapaxes(1, 2)
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


def _search_near(
    queries: Float[Array, "q d"],
    is_asked: Bool[Array, ""],
    groups: Float[Array, "g p d"],
    boxes: tuple[Float[Array, "g d"], Float[Array, "g d"]],
    num_near: int,
    k: int,
) -> tuple[Int[Array, "k q"], Float[Array, "k q"]]:
    """`_search` in the `num_near` groups nearest to the queries' box, then in the next, until none is nearer."""
    low, high = boxes
    gaps = jnp.maximum(jnp.maximum(low - jnp.max(queries, axis=0), jnp.min(queries, axis=0) - high), 0.0)

    def is_open(state: tuple) -> Bool[Array, ""]:
        ahead_sq, (_, distance_sq) = state
        nearest_sq = jnp.min(ahead_sq)
        return is_asked & jnp.isfinite(nearest_sq) & ~jnp.all(distance_sq[-1] <= nearest_sq)

    def look(state: tuple) -> tuple:
        ahead_sq, found = state
        near_sq, near = jax.lax.top_k(-ahead_sq, num_near)
        # The last turn may have room left, which must not be filled with groups that were looked at before.
        members = jnp.where(jnp.isfinite(near_sq)[:, None, None], groups[near], jnp.inf)
        index, distance_sq = _search(queries, members.reshape(-1, groups.shape[2]), k)
        rows = near[index // GROUP] * GROUP + index % GROUP
        both = jax.tree.map(lambda old, new: jnp.concatenate([old, new]), found, (rows, distance_sq))
        best = smallest(both[1], k)
        found = jax.tree.map(lambda values: jnp.take_along_axis(values, best, axis=0), both)
        return ahead_sq.at[near].set(jnp.inf), found

    nothing = jnp.zeros((k, queries.shape[0]), jnp.int32), jnp.full((k, queries.shape[0]), jnp.inf)
    return jax.lax.while_loop(is_open, look, (jnp.sum(gaps**2, axis=-1), nothing))[1]


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
    count = jnp.sum(mask)
    rows = jnp.searchsorted(jnp.cumsum(mask), jnp.arange(1, capacity + 1))
    exists = jnp.arange(capacity) < count
    overflow = jnp.maximum(count - capacity, 0)
    return jnp.where(exists, rows, mask.shape[0]), exists, overflow
