"""Nearest neighbours against brute force in float64, and compaction against literals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from emgs_jax.ops.neighbours import CURVE_BITS, _curve, compact_rows, knn

search = jax.jit(knn, static_argnums=3)


def check(queries, points, valid, k):
    """Rows are distinct valid points whose distances are the k smallest, ascending; missing ones are marked."""
    rows, found = (np.asarray(x) for x in search(*map(jnp.asarray, (queries, points, valid)), k))
    expected = reference.knn(queries, points, valid, k)
    np.testing.assert_array_equal(found, np.isfinite(expected))
    for i in range(len(queries)):
        chosen = rows[i, found[i]]
        assert len(set(chosen)) == len(chosen) and np.asarray(valid)[chosen].all()
        distances = np.linalg.norm(points[chosen].astype(float) - queries[i], axis=-1)
        # `smallest` takes squared distances that differ by n · 2⁻²³ of themselves as equal; each has a few roundings.
        precision = max(len(points), 32) * 2.0**-23 + 1e-6
        np.testing.assert_allclose(distances**2, expected[i, found[i]] ** 2, rtol=precision, atol=1e-9)


@pytest.mark.parametrize(("n", "k"), [(1, 1), (7, 7), (33, 5), (64, 1), (200, 16), (1000, 3)])
def test_neighbours_equal_brute_force_for_any_count(n, k):
    rng = np.random.default_rng(n)
    points = rng.uniform(-1, 1, (n, 3)).astype(np.float32)
    check(rng.uniform(-1, 1, (40, 3)).astype(np.float32), points, rng.uniform(size=n) < 0.9, k)


def test_neighbours_on_the_image_plane_equal_brute_force():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (100, 2)).astype(np.float32)
    check(points[:30] + np.float32(0.01), points, np.ones(100, bool), 3)


def test_more_queries_than_a_block_equal_brute_force():
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (70, 3)).astype(np.float32)
    check(rng.uniform(-1, 1, (300, 3)).astype(np.float32), points, np.ones(70, bool), 4)


@pytest.mark.parametrize("k", [1, 5])
def test_where_blocks_look_at_near_groups_only_and_where_they_must_look_on_neighbours_equal_brute_force(k):
    """A surface, whose blocks are compact, and queries far from it and from each other, whose blocks are not."""
    rng = np.random.default_rng(6)
    plane = rng.uniform(-1, 1, (2400, 3)).astype(np.float32) * np.float32([1, 1, 0.01])
    queries = np.concatenate([plane[::2], rng.uniform(-5, 5, (100, 3)).astype(np.float32)])
    check(rng.permutation(queries), plane, rng.uniform(size=2400) < 0.9, k)


def test_queries_that_are_not_asked_change_nothing_for_the_others():
    """Among them are ones at infinity, as free rows of a map may be."""
    rng = np.random.default_rng(9)
    points, queries = (rng.uniform(-1, 1, (count, 3)).astype(np.float32) for count in (2400, 900))
    asked = rng.uniform(size=900) < 0.3
    queries[~asked & (rng.uniform(size=900) < 0.5)] = np.inf
    rows, found = search(*map(jnp.asarray, (queries, points, np.ones(2400, bool))), 4, jnp.asarray(asked))
    expected = reference.knn(queries[asked], points, np.ones(2400, bool), 4)
    assert np.asarray(found)[asked].all()
    distances = np.linalg.norm(points[np.asarray(rows)[asked]] - queries[asked][:, None], axis=-1)
    np.testing.assert_allclose(distances, expected, rtol=1e-4)


def test_a_block_that_looks_at_few_groups_first_looks_on_until_all_k_are_found(monkeypatch):
    """Two groups of 32 a turn, and sixteen neighbours: the nearest is found at once, the last often much later."""
    monkeypatch.setattr("emgs_jax.ops.neighbours.NUM_NEAR", 1)
    rng = np.random.default_rng(9)
    points, queries = (rng.uniform(-1, 1, (count, 3)).astype(np.float32) for count in (600, 1280))
    rows, found = jax.jit(lambda *arrays: knn(*arrays, 16))(queries, points, np.ones(600, bool))  # a trace of its own
    assert np.asarray(found).all()
    distances = np.linalg.norm(points[rows] - queries[:, None], axis=-1)
    expected = reference.knn(queries, points, np.ones(600, bool), 16)
    np.testing.assert_allclose(distances, expected, rtol=600 * 2.0**-23)  # of `smallest`, as above


def test_an_accelerator_which_looks_at_all_points_in_one_turn_finds_the_same(monkeypatch):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *operands, default, **_: default(*operands))
    rng = np.random.default_rng(8)
    points, queries = (rng.uniform(-1, 1, (count, 3)).astype(np.float32) for count in (700, 300))
    valid = rng.uniform(size=700) < 0.9
    rows, found = jax.jit(lambda *arrays: knn(*arrays, 5))(queries, points, valid)  # a trace of its own
    expected = reference.knn(queries, points, valid, 5)
    assert np.asarray(found).all() and valid[np.asarray(rows)].all()
    np.testing.assert_allclose(
        np.linalg.norm(points[rows] - queries[:, None], axis=-1), expected, rtol=700 * 2.0**-23
    )  # as above


def test_with_fewer_valid_points_than_k_the_rest_is_marked():
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    check(points, points, np.array([False, True, False, True]), 3)
    check(points, points, np.zeros(4, bool), 2)


def test_duplicates_are_found_each_once():
    points = np.repeat(np.random.default_rng(3).uniform(-1, 1, (10, 3)), 8, axis=0).astype(np.float32)
    check(points[::8], points, np.ones(80, bool), 12)


def test_far_from_the_origin_the_nearest_is_still_found():
    points = np.random.default_rng(4).uniform(-1, 1, (100, 3)).astype(np.float32) + np.float32(1000)
    check(points[:20], points, np.ones(100, bool), 1)


def test_the_nearest_comes_first():
    points = jnp.array([[3.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]])
    rows, _ = search(jnp.zeros((1, 3)), points, jnp.ones(4, bool), 3)
    np.testing.assert_array_equal(rows, [[1, 2, 0]])


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e6])
def test_invalid_points_change_nothing(poison):
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (90, 3)).astype(np.float32)
    valid = rng.uniform(size=90) < 0.6
    poisoned = np.where(valid[:, None], points, np.float32(poison))
    clean = search(points[:20], points, valid, 6)
    for a, b in zip(search(points[:20], poisoned, valid, 6), clean, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e6])
def test_a_wild_query_changes_no_other(poison):
    rng = np.random.default_rng(7)
    points = rng.uniform(-1, 1, (900, 3)).astype(np.float32)
    queries = rng.uniform(-1, 1, (900, 3)).astype(np.float32)
    is_wild = (np.arange(900) % 9 == 0)[:, None]
    rows, found = search(np.where(is_wild, np.float32(poison), queries), points, np.ones(900, bool), 5)
    clean, _ = search(queries, points, np.ones(900, bool), 5)
    np.testing.assert_array_equal(np.asarray(rows)[~is_wild[:, 0]], np.asarray(clean)[~is_wild[:, 0]])
    assert np.asarray(found)[~is_wild[:, 0]].all()


def test_compaction_lists_the_true_rows_in_order_and_counts_what_did_not_fit():
    mask = jnp.array([False, True, True, False, True])
    rows, exists, overflow = compact_rows(mask, 4)
    np.testing.assert_array_equal(rows, [1, 2, 4, 5])  # 5 = past the end
    np.testing.assert_array_equal(exists, [True, True, True, False])
    assert overflow == 0
    rows, exists, overflow = compact_rows(mask, 2)  # capacity - 1
    np.testing.assert_array_equal(rows, [1, 2])
    assert exists.all() and overflow == 1


def test_compaction_of_nothing_is_all_missing():
    rows, exists, overflow = compact_rows(jnp.zeros(3, bool), 5)
    np.testing.assert_array_equal(rows, [3] * 5)
    assert not exists.any() and overflow == 0


@pytest.mark.parametrize("num_axes", [2, 3])
def test_the_curve_passes_every_cell_once_from_neighbour_to_neighbour(num_axes):
    axis = np.arange(16)  # the first cube of 16 cells a side, which the curve fills before it goes on
    cells = np.stack(np.meshgrid(*[axis] * num_axes, indexing="ij"), axis=-1).reshape(-1, num_axes)
    box = jnp.zeros(num_axes), jnp.full(num_axes, 2.0**CURVE_BITS)
    numbers = np.asarray(_curve(jnp.asarray(cells + 0.5, jnp.float32), *box))
    np.testing.assert_array_equal(np.sort(numbers), np.arange(16**num_axes))
    steps = np.diff(cells[np.argsort(numbers)], axis=0)
    np.testing.assert_array_equal(np.abs(steps).sum(axis=1), 1)
