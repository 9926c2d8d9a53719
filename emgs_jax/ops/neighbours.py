"""Nearest neighbours and compaction with static shapes.

Queries are searched in blocks: queries near each other share a list of the points nearest to any of them, and choose
from it. All is a few large operations on dense arrays, with one small sort for each set of positions. That suits GPUs
and the vector units of CPUs alike.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from emgs_jax.ops.linalg import between, dot
from emgs_jax.ops.pytree import fill_rows, join_rows, split_rows
from emgs_jax.ops.ranges import MAX_LENGTH_M

GROUP = 16  # points per group: near each other
NUM_GROUPS = 24  # groups that a block of queries searches
BLOCK = 8  # queries of a block of `knn`
LEAST_LISTED = 32  # smallest list of a block; by default it has six times as many points as wanted
RANKED = 12  # values compared with all others at once
CURVE_BITS = 10  # per axis, of the cells of the Hilbert curve
NUM_SAMPLED = 64  # positions whose gaps determine these cells
WIDE_GAP = 16.0  # times the usual gap; wider gaps between positions are cut to this
FAR = 1e18  # m; position of points that do not count: their squared distance is finite and larger than any other
FAR_SQ = 0.5 * FAR**2  # m²; a smaller squared distance is of two points that count
MAX_BLOCKS = 4096  # compared with their groups at once; more are done in parts


class Groups(eqx.Module):
    """Points sorted along a space-filling curve, so that every GROUP consecutive ones are near each other.

    Args:
        positions: of the members, coordinate by coordinate; FAR for empty slots.
        rows: of the members in the original array.
        low, high: corners of each group's bounding box.
    """

    positions: Float[Array, "g d p"]
    rows: Int[Array, "g p"]
    low: Float[Array, "g d"]
    high: Float[Array, "g d"]


class Nearby(eqx.Module):
    """Nearest points of each block of queries.

    Args:
        queries: rows of a block's queries; one past the last row for unused slots.
        rows: of the points that are nearest to any query of the block, nearest first.
        exists: False for slots without a point.
        beyond_sq: m²; no other point is nearer to a query of the block.
    """

    queries: Int[Array, "b q"]
    rows: Int[Array, "b c"]
    exists: Bool[Array, "b c"]
    beyond_sq: Float[Array, "b"]


def is_within_reach(positions: Float[Array, "*m d"]) -> Bool[Array, "*m"]:
    """Tell which positions are finite and within the range of a map along each axis."""
    return jnp.all(jnp.abs(positions) < MAX_LENGTH_M, axis=-1)


def curve_order(positions: Float[Array, "m d"], counts: Bool[Array, "m"]) -> Int[Array, "m"]:
    """Sort rows along the Hilbert curve through the positions that count; the others come last."""
    number = _curve(_cells(positions, counts))
    return jnp.argsort(jnp.where(counts, number, jnp.iinfo(jnp.int32).max))


def _cells(positions: Float[Array, "m d"], counts: Bool[Array, "m"]) -> tuple[Int[Array, "m"], ...]:
    """Assign cells along each axis, of equal size except in empty space.

    A sample of positions gives the gaps along an axis. A gap that is much wider than most is shortened, so that a point
    far away, or another room, does not enlarge the cells of the others.
    """
    low = jnp.min(jnp.where(counts[:, None], positions, jnp.inf), axis=0)
    high = jnp.max(jnp.where(counts[:, None], positions, -jnp.inf), axis=0)
    place = jnp.cumsum(counts)
    # Multiples of the golden section, to match no stride of pixel rows.
    wanted = jnp.floor(jnp.mod(0.618034 * jnp.arange(NUM_SAMPLED), 1.0) * place[-1])
    rows = jnp.searchsorted(place, wanted.astype(place.dtype), side="right")
    some = jnp.take(positions, rows, axis=0, mode="clip")
    known = jnp.sort(jnp.concatenate([low[None], some, high[None]]), axis=0)
    gaps = jnp.diff(known, axis=0)
    usual = jnp.max(jnp.median(gaps, axis=0))
    cut = jnp.minimum(gaps, jnp.where(usual > 0, WIDE_GAP * usual, jnp.inf))
    ends = jnp.concatenate([jnp.zeros_like(cut[:1]), jnp.cumsum(cut, axis=0)])
    size = jnp.max(ends)
    unit = 2**CURVE_BITS / jnp.where((size > 0) & jnp.isfinite(size), size, 1.0)
    # One axis after the other; otherwise XLA looks all of them up again for each.
    scaled = (unit * jnp.interp(*axis) for axis in zip(positions.T, known.T, ends.T, strict=True))
    last = 2**CURVE_BITS - 1
    return tuple(jnp.clip(jnp.where(jnp.isfinite(x), x, 0.0), 0, last).astype(jnp.int32) for x in scaled)


def group_points(points: Float[Array, "n d"], valid: Bool[Array, "n"], order: Int[Array, "n"] | None = None) -> Groups:
    """Group the valid points along `order`; None: along the curve."""
    points = jax.lax.stop_gradient(points)  # a row number has no gradient
    valid &= is_within_reach(points)
    order = curve_order(points, valid) if order is None else order
    counts = fill_rows(valid[order], GROUP, False).reshape(-1, GROUP)
    members = fill_rows(points[order], GROUP, FAR).reshape(-1, GROUP, points.shape[1])
    near, far = jnp.where(counts[..., None], members, FAR), jnp.where(counts[..., None], members, -FAR)
    rows = fill_rows(order, GROUP, 0).reshape(-1, GROUP)
    return Groups(near.swapaxes(1, 2), rows, jnp.min(near, axis=1), jnp.max(far, axis=1))


def order_of(groups: Groups, num_points: int) -> Int[Array, "n"]:
    """Return the order of the grouped points, for a search of the same points among themselves."""
    return groups.rows.reshape(-1)[:num_points]


def nearby(
    queries: Float[Array, "m d"],
    asked: Bool[Array, "m"],
    groups: Groups,
    count: int,
    size: int,
    order: Int[Array, "m"] | None = None,
) -> Nearby:
    """List the `count` points nearest to any query of each block, among the groups with the nearest boxes.

    Args:
        asked: queries that count; one that is not within reach never does.
        count: length of the list, static; at most the points of NUM_GROUPS groups.
        size: queries of a block, static.
        order: of the queries; `size` consecutive ones are a block; None: along the curve.
    """
    queries, groups = jax.lax.stop_gradient((queries, groups))
    asked &= is_within_reach(queries)
    order = curve_order(queries, asked) if order is None else order
    rows = fill_rows(order, size, queries.shape[0]).reshape(-1, size)
    counts = fill_rows(asked[order], size, False).reshape(-1, size)
    blocks = jnp.where(counts[..., None], queries.at[rows].get(mode="clip"), -FAR)
    count = min(count, groups.rows.size)
    parts = split_rows((blocks, counts), MAX_BLOCKS)
    found = jax.lax.map(lambda part: _nearest_to_any(*part, groups, count), parts)
    return Nearby(rows, *join_rows(found, rows.shape[0]))


def _nearest_to_any(
    blocks: Float[Array, "b q d"], counts: Bool[Array, "b q"], groups: Groups, count: int
) -> tuple[Int[Array, "b c"], Bool[Array, "b c"], Float[Array, "b"]]:
    """Do `nearby` for given blocks; a query that does not count is at -FAR."""
    gap_sq = _distance_to_boxes_sq(blocks, groups)
    num_groups = min(max(NUM_GROUPS, -(-count // GROUP)), groups.rows.shape[0])
    negative, near = jax.lax.top_k(-gap_sq, num_groups)
    # The minimum of `top_k`'s result, not its last column: XLA sorts everything if the result is sliced.
    beyond_sq = -jnp.min(negative, axis=1)
    if num_groups == groups.rows.shape[0]:  # search all of them
        beyond_sq = jnp.full_like(beyond_sq, jnp.inf)
    members = [values[near].reshape(near.shape[0], -1) for values in jnp.unstack(groups.positions, axis=1)]
    # One query and one coordinate at a time: sums over short axes do not fill a CPU's vector units.
    nearest_sq = jnp.full(members[0].shape, jnp.inf)
    for query in jnp.unstack(blocks, axis=1):
        offsets = tuple(x[:, None] - y for x, y in zip(jnp.unstack(query, axis=-1), members, strict=True))
        nearest_sq = jnp.minimum(nearest_sq, dot(offsets, offsets))
    negative, best = jax.lax.top_k(-nearest_sq, count)
    rows = groups.rows[jnp.take_along_axis(near, best // GROUP, axis=1), best % GROUP]
    if count < nearest_sq.shape[1]:  # points nearby that are not in the list
        beyond_sq = jnp.minimum(beyond_sq, -jnp.min(negative, axis=1))
    return rows, negative > -FAR_SQ, beyond_sq


def _distance_to_boxes_sq(blocks: Float[Array, "b q d"], groups: Groups) -> Float[Array, "b g"]:
    """Compute the squared distance of the groups' boxes to the nearest query of each block.

    Not to the block's own box: for queries that are far apart it would contain many groups, none of them near.
    """
    corners = tuple(zip(jnp.unstack(groups.low, axis=-1), jnp.unstack(groups.high, axis=-1), strict=True))
    nearest_sq = jnp.full((blocks.shape[0], groups.rows.shape[0]), jnp.inf)
    for query in jnp.unstack(blocks, axis=1):
        entries = zip(jnp.unstack(query[:, None], axis=-1), corners, strict=True)
        gaps = tuple(jnp.maximum(jnp.maximum(low - x, x - high), 0.0) for x, (low, high) in entries)
        nearest_sq = jnp.minimum(nearest_sq, dot(gaps, gaps))
    return nearest_sq


def of_queries(near: Nearby, values: Shaped[Array, "b q *v"], num_queries: int) -> Shaped[Array, "m *v"]:
    """Reorder values from blocks to the order of the queries."""
    return jnp.zeros((num_queries, *values.shape[2:]), values.dtype).at[near.queries].set(values, mode="drop")


def among_nearest(distance_sq: Float[Array, "*b c"], exists: Bool[Array, "*#b c"], k: int) -> Bool[Array, "*b c"]:
    """Mark the k nearest of the existing points among c."""
    return exists & (ranks(jnp.where(exists, distance_sq, jnp.inf)) < k)


def nearest(
    queries: Float[Array, "m d"],
    asked: Bool[Array, "m"],
    points: Float[Array, "n d"],
    groups: Groups,
    k: int,
    size: int = BLOCK,
    count: int = 0,
    order: Int[Array, "m"] | None = None,
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Find the k nearest points of every query among those `nearby` its block, nearest first.

    For positions on surfaces the result is nearly always that of `knn`; the farthest of the k may be missed.

    Args:
        asked: queries that count; the others may have any answer or none.
        size: queries of a block, static.
        count: length of a block's list; by default 6 k, at least 32.
        order: of the queries; None: along the curve.

    Returns:
        Row numbers into `points`, and which of them exist.
    """
    near, distance_sq, rank = _ranked(queries, asked, points, groups, size, count or max(6 * k, LEAST_LISTED), order)
    return _existing(_first(near, distance_sq, rank, k, queries.shape[0]))


def knn(
    queries: Float[Array, "m d"],
    points: Float[Array, "n d"],
    valid: Bool[Array, "n"],
    k: int,
    asked: Bool[Array, "m"] | None = None,
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Find the k nearest valid points of every query, nearest first, exactly.

    Like `nearest`, but a block whose list may lack one of them is compared with all points, one block at a time.

    Args:
        k: number of neighbours, static; at most n.
        asked: queries that need an answer, None for all.

    Returns:
        Row numbers into `points`, and which of them exist: False if fewer than k points are valid. A query that does
        not count may have any or none.
    """
    queries, points = jax.lax.stop_gradient((queries, points))  # a row number has no gradient
    asked = jnp.ones(queries.shape[0], bool) if asked is None else asked
    valid &= is_within_reach(points)
    groups = group_points(points, valid)
    near, distance_sq, rank = _ranked(queries, asked, points, groups, BLOCK, max(6 * k, LEAST_LISTED), None)
    found = _first(near, distance_sq, rank, k, queries.shape[0])
    blocks = queries.at[near.queries].get(mode="clip")
    is_asked = asked.at[near.queries].get(mode="fill", fill_value=False)
    farthest_sq = jnp.max(jnp.where(rank < k, distance_sq, 0.0), axis=-1)
    is_open = jnp.any(is_asked & (farthest_sq > near.beyond_sq[:, None]), axis=1)
    open_blocks, _, _ = compact_rows(is_open, is_open.shape[0])

    def look_at_all(number: Int[Array, ""], found: Int[Array, "m k"]) -> Int[Array, "m k"]:
        block = open_blocks[number]
        distance_sq = jnp.sum((blocks[block][:, None] - points) ** 2, axis=-1)
        negative, rows = jax.lax.top_k(-jnp.where(valid, distance_sq, jnp.inf), k)
        return found.at[near.queries[block]].set(jnp.where(negative > -FAR_SQ, rows, -1), mode="drop")

    return _existing(jax.lax.fori_loop(0, jnp.sum(is_open), look_at_all, found))


def _ranked(
    queries: Float[Array, "m d"],
    asked: Bool[Array, "m"],
    points: Float[Array, "n d"],
    groups: Groups,
    size: int,
    count: int,
    order: Int[Array, "m"] | None,
) -> tuple[Nearby, Float[Array, "b q c"], Int[Array, "b q c"]]:
    """Find the points near each block, with their squared distance and rank for every query of the block."""
    queries, points = jax.lax.stop_gradient((queries, points))
    near = nearby(queries, asked, groups, count, size, order)
    blocks = queries.at[near.queries].get(mode="clip")
    offsets = between(blocks, jnp.where(near.exists[..., None], points[near.rows], FAR))
    distance_sq = dot(offsets, offsets)
    return near, distance_sq, ranks(distance_sq)


def _first(
    near: Nearby, distance_sq: Float[Array, "b q c"], rank: Int[Array, "b q c"], k: int, num_queries: int
) -> Int[Array, "m k"]:
    """Return the rows of the first k ranks, in the order of the queries; -1 for none."""
    rows = jnp.where(distance_sq < FAR_SQ, near.rows[:, None], -1)
    # Each row goes to its query and rank; ranks beyond k fall off the end.
    return jnp.full((num_queries, k), -1, rows.dtype).at[near.queries[..., None], rank].set(rows, mode="drop")


def _existing(found: Int[Array, "m k"]) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    """Split into row numbers and which of them exist; row 0 for the others."""
    return jnp.maximum(found, 0), found >= 0


def ranks(values: Float[Array, "*b c"]) -> Int[Array, "*b c"]:
    """Rank c values that are not negative: 0 for the smallest; no two share a rank.

    A few values at a time are compared with all: whole-vector operations instead of a sort of each row. They run in a
    loop; otherwise XLA would repeat them for every use of the ranks. Values that differ by less than c · 2⁻²³ of
    themselves count as equal and keep their order.
    """
    num = values.shape[-1]
    # Floats that are not negative sort like their bits; the last bits hold the position.
    place_bits = (1 << (num - 1).bit_length()) - 1
    keys = (jax.lax.bitcast_convert_type(values, jnp.int32) & ~place_bits) | jnp.arange(num)
    others = jnp.pad(keys, [(0, 0)] * (keys.ndim - 1) + [(0, -num % RANKED)], constant_values=jnp.iinfo(jnp.int32).max)

    def compare(turn: Int[Array, ""], rank: Int[Array, "*b c"]) -> Int[Array, "*b c"]:
        some = jax.lax.dynamic_slice_in_dim(others, turn * RANKED, RANKED, axis=-1)
        return rank + sum(some[..., number : number + 1] < keys for number in range(RANKED))

    return jax.lax.fori_loop(0, -(-num // RANKED), compare, jnp.zeros(keys.shape, jnp.int32))


def _curve(cells: tuple[Int[Array, "m"], ...]) -> Int[Array, "m"]:
    """Number every cell along the Hilbert curve.

    Source: Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707, 2004. Consecutive cells touch, so groups are
    compact: a search takes an eighth less time than along the Z curve.
    """
    axes = list(cells)
    for bit in range(CURVE_BITS - 1, 0, -1):  # undo the rotations of every cube, from the largest on
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


def compact_rows(mask: Bool[Array, "n"], capacity: int) -> tuple[Int[Array, "c"], Bool[Array, "c"], Int[Array, ""]]:
    """Find the row numbers of the first `capacity` True entries, in order.

    Returns:
        The rows (n for empty slots, which `put_rows` drops), which of them exist, and how many did not fit.
    """
    count = jnp.sum(mask)
    places = jnp.where(mask, jnp.cumsum(mask) - 1, capacity)
    rows = jnp.full(capacity, mask.shape[0], jnp.int32).at[places].set(jnp.arange(mask.shape[0]), mode="drop")
    return rows, jnp.arange(capacity) < count, jnp.maximum(count - capacity, 0)
