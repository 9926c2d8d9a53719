"""Nearest neighbours against brute force in float64, and compaction against literals."""

import jax
import numpy as np
import pytest
from scene import on_host
from scipy.spatial import cKDTree

from emgs_jax.ops.neighbours import compact_rows, curve_order, group_points, knn, nearest

search, compacted, along_curve = on_host(knn), on_host(compact_rows), on_host(curve_order)
roughly = on_host(lambda queries, points, valid, asked: nearest(queries, asked, points, group_points(points, valid), 3))
# Sizes of most tests, so that they share programs: a few blocks of queries among few and among many groups of points.
NUM_QUERIES, NUM_POINTS, MANY_QUERIES, MANY_POINTS = 300, 1000, 1300, 2400


def uniform(seed, *shape, low=-1.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def filled(rows, count):
    """With rows after them that are the last one again."""
    return rows[np.minimum(np.arange(count), len(rows) - 1)]


def check(queries, points, valid, k, asked=None):
    """Rows are distinct valid points whose distances are the k smallest, ascending; missing ones are marked."""
    rows, found = search(queries, points, valid, k) if asked is None else search(queries, points, valid, k, asked)
    valid, is_answer = np.asarray(valid), np.ones(len(queries), bool) if asked is None else asked
    kept, num_found = points[valid].astype(float), min(k, int(valid.sum()))
    assert (found[is_answer] == (np.arange(k) < num_found)).all() and not rows[~found].any()
    if num_found == 0:
        return
    expected, _ = cKDTree(kept).query(queries[is_answer].astype(float), np.arange(1, num_found + 1))
    chosen = rows[is_answer][:, :num_found]
    assert valid[chosen].all() and all(len(set(row)) == num_found for row in chosen)
    distances = np.linalg.norm(points[chosen].astype(float) - queries[is_answer][:, None], axis=-1)
    # Squared distances that differ by n · 2⁻²³ of themselves are taken as equal; each has a few roundings.
    precision = max(len(points), 32) * 2.0**-23 + 1e-6
    np.testing.assert_allclose(distances**2, expected**2, rtol=precision, atol=1e-9)


@pytest.mark.parametrize(("n", "k"), [(1, 1), (200, 16), (NUM_POINTS, 5)])
def test_neighbours_equal_brute_force_for_any_count(n, k):
    check(uniform(1, NUM_QUERIES, 3), uniform(n, n, 3), np.random.default_rng(n).uniform(size=n) < 0.9, k)


def test_neighbours_on_the_image_plane_equal_brute_force():
    points = uniform(1, 100, 2)
    check(points[:30] + np.float32(0.01), points, np.ones(100, bool), 3)


EVERY = np.ones(MANY_QUERIES, bool)


@pytest.mark.parametrize("k", [1, 16])
def test_near_queries_and_scattered_ones_among_many_points_equal_brute_force(k):
    """A surface, and queries far from it and from each other: of sixteen neighbours the last is found much later."""
    plane = uniform(6, MANY_POINTS, 3) * np.float32([1, 1, 0.01])
    queries = np.concatenate([plane[::2], uniform(7, 100, 3, low=-5, high=5)])
    valid = np.random.default_rng(6).uniform(size=MANY_POINTS) < 0.9
    check(np.random.default_rng(8).permutation(queries), plane, valid, k, EVERY)


@pytest.mark.parametrize("count", [8, 100, NUM_QUERIES])
def test_few_queries_that_are_far_from_each_other_find_what_is_nearest_to_each(count):
    """As the candidates of a frame that the map explains but for some corners: a box round a block holds all."""
    floor = uniform(16, MANY_POINTS, 3) * np.float32([30, 30, 0.01])
    queries = filled(uniform(17, count, 3) * np.float32([30, 30, 0.0]), NUM_QUERIES)
    rows, found = roughly(queries, floor, np.ones(MANY_POINTS, bool), np.arange(NUM_QUERIES) < count)
    expected, _ = cKDTree(floor.astype(float)).query(queries[:count].astype(float))
    distances = np.linalg.norm(floor[rows[:count, 0]].astype(float) - queries[:count], axis=-1)
    assert found[:count].all()
    np.testing.assert_allclose(distances, expected, rtol=1e-3)  # ranks take what differs by less as equal


@pytest.mark.parametrize("spread", [0.02, 50.0])
def test_points_that_are_crowded_or_far_apart_equal_brute_force(spread):
    """Most of them in one place, the others all over: cells of one size hold nearly all or nearly none."""
    points = uniform(11, MANY_POINTS, 3) * np.where(np.arange(MANY_POINTS)[:, None] % 8, np.float32(0.02), spread)
    queries = uniform(12, MANY_QUERIES, 3) * np.where(np.arange(MANY_QUERIES)[:, None] % 4, np.float32(0.02), spread)
    check(queries.astype(np.float32), points.astype(np.float32), np.ones(MANY_POINTS, bool), 16, EVERY)


def test_the_search_does_not_end_with_the_nearest():
    """One point among the queries, and a shell about them: the others are anywhere on it."""
    shell = uniform(13, MANY_POINTS, 3)
    shell *= uniform(14, MANY_POINTS, 1, low=0.95, high=1.05) / np.linalg.norm(shell, axis=1, keepdims=True)
    shell[0] = 0.0
    check(np.float32(0.01) * uniform(15, MANY_QUERIES, 3), shell, np.ones(MANY_POINTS, bool), 16, EVERY)


def test_queries_that_are_not_asked_change_nothing_for_the_others():
    """Among them are ones at infinity, as free rows of a map may be."""
    rng, queries = np.random.default_rng(9), uniform(10, MANY_QUERIES, 3)
    asked = rng.uniform(size=MANY_QUERIES) < 0.3
    queries[~asked & (rng.uniform(size=MANY_QUERIES) < 0.5)] = np.inf
    check(queries, uniform(9, MANY_POINTS, 3), np.ones(MANY_POINTS, bool), 16, asked)


def test_an_accelerator_which_looks_at_all_points_in_one_turn_finds_the_same(monkeypatch):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *operands, default, **_: default(*operands))
    points, queries = uniform(8, 700, 3), uniform(9, 300, 3)
    rows, found = on_host(lambda *arrays: knn(*arrays, 5))(queries, points, np.ones(700, bool))  # a trace of its own
    expected, _ = cKDTree(points.astype(float)).query(queries, 5)
    assert found.all()
    distances = np.linalg.norm(points[rows] - queries[:, None], axis=-1)
    np.testing.assert_allclose(distances, expected, rtol=700 * 2.0**-23)  # as above


@pytest.mark.parametrize("num_valid", [0, 1, 3])
def test_with_fewer_valid_points_than_k_the_rest_is_marked(num_valid):
    valid = np.isin(np.arange(NUM_POINTS), [7, 500, 901][:num_valid])
    check(uniform(2, NUM_QUERIES, 3), uniform(1, NUM_POINTS, 3), valid, 5)


def test_duplicates_are_found_each_once():
    points = np.repeat(uniform(3, NUM_POINTS // 8, 3), 8, axis=0)
    check(filled(points[::8], NUM_QUERIES), points, np.arange(NUM_POINTS) % 8 < 3, 5)


def test_far_from_the_origin_the_nearest_is_still_found():
    points = uniform(4, NUM_POINTS, 3) + np.float32(1000)
    rows, _ = search(points[:NUM_QUERIES], points, np.ones(NUM_POINTS, bool), 5)
    distances = np.linalg.norm(points[rows[:, 0]] - points[:NUM_QUERIES], axis=-1)
    np.testing.assert_array_equal(distances, 0)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e6])
def test_invalid_points_and_wild_queries_change_nothing(poison):
    points, queries = uniform(5, NUM_POINTS, 3), uniform(7, NUM_QUERIES, 3)
    valid, is_wild = np.random.default_rng(5).uniform(size=NUM_POINTS) < 0.6, np.arange(NUM_QUERIES) % 9 == 0
    clean = search(queries, points, valid, 5)
    with_points = search(queries, np.where(valid[:, None], points, np.float32(poison)), valid, 5)
    with_queries = search(np.where(is_wild[:, None], np.float32(poison), queries), points, valid, 5)
    for a, b, c in zip(clean, with_points, with_queries, strict=True):
        np.testing.assert_array_equal(b, a)
        np.testing.assert_array_equal(c[~is_wild], a[~is_wild])


def test_the_curve_goes_from_each_cube_to_one_that_touches_it_and_what_does_not_count_comes_last():
    """By which a group is compact: any order gives the same neighbours, and takes longer."""
    cubes = np.random.default_rng(17).permutation(np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3))
    beside = np.array([[3.0, np.nan, 1.0], [100.0, 0.0, 0.0]])
    positions = np.concatenate([beside, 0.1 * cubes - 5.0]).astype(np.float32)
    order = along_curve(positions, np.arange(len(positions)) >= len(beside))
    steps = np.diff(cubes[order[: len(cubes)] - len(beside)], axis=0)
    assert (np.abs(steps).sum(axis=1) == 1).all()
    assert sorted(order[len(cubes) :]) == [0, 1]


def test_compaction_lists_the_true_rows_in_order_and_counts_what_did_not_fit():
    mask = np.array([False, True, True, False, True])
    rows, exists, overflow = compacted(mask, 4)
    np.testing.assert_array_equal(rows, [1, 2, 4, 5])  # 5 = past the end
    np.testing.assert_array_equal(exists, [True, True, True, False])
    assert overflow == 0
    rows, exists, overflow = compacted(mask, 2)  # capacity - 1
    np.testing.assert_array_equal(rows, [1, 2])
    assert exists.all() and overflow == 1
    rows, exists, overflow = compacted(np.zeros(3, bool), 5)
    np.testing.assert_array_equal(rows, [3] * 5)
    assert not exists.any() and overflow == 0


AROUND = on_host(lambda q, p: nearest(q, q[:, 0] > -np.inf, p, group_points(p, p[:, 0] > -np.inf), 4))
FAR_AWAY = {
    "one": lambda points: np.where(np.arange(len(points))[:, None] == 7, np.float32([0, 0, 1000]), points),
    "a sky": lambda points: np.where(np.arange(len(points))[:, None] % 3 == 0, 1e4 * points, points),
    "another room": lambda points: points + np.where(np.arange(len(points))[:, None] % 2 == 0, np.float32(2000), 0),
    "beyond any map": lambda points: np.where(np.arange(len(points))[:, None] == 7, np.float32(1e30), points),
}


@pytest.mark.parametrize("what", FAR_AWAY)
@pytest.mark.parametrize("is_query", [False, True])
def test_what_is_far_away_takes_no_neighbour_from_others(what, is_query):
    """One Gaussian at 1 km left all others of a room in one cell: a fifth of the points got a farther one."""
    x, y = np.meshgrid(np.arange(40), np.arange(60))
    grid = np.stack([x / 20 - 1, y / 20 - 1.5, 2 + 0.1 * np.sin(x / 5)], axis=-1).reshape(-1, 3).astype(np.float32)
    grid = np.random.default_rng(2).permutation(grid)
    points, queries = grid[::2], grid[: NUM_QUERIES * 4 : 4] + np.float32(0.003)
    if is_query:
        queries, is_here = FAR_AWAY[what](queries), FAR_AWAY[what](queries)[:, 2] < 10
    else:
        points, is_here = FAR_AWAY[what](points), np.ones(len(queries), bool)
    rows, found = AROUND(queries, points)
    kept = np.where(np.abs(points[:, :1]) < 1e6, points, np.float32(1e9)).astype(float)
    nearest_m = cKDTree(kept).query(queries[is_here].astype(float))[0]
    got = np.linalg.norm(kept[rows[is_here, 0]] - queries[is_here], axis=1)
    assert found[is_here].all() and (got > 1.01 * nearest_m + 1e-6).mean() < 0.01
