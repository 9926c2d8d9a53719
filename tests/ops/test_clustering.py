"""k-means against Lloyd in NumPy and its limits; seeds and the Z curve against literals."""

import numpy as np
import pytest
import reference
from scene import on_host

from emgs_jax.ops import clustering
from emgs_jax.ops.clustering import kmeans, morton_order

cluster, strided_seeds = on_host(kmeans), on_host(clustering.strided_seeds)
RNG = np.random.default_rng(0)
NUM_POINTS, NUM_SEEDS = 150, 12


@pytest.mark.parametrize(("height", "width"), [(5, 7), (24, 32), (9, 1), (3, 70)])
def test_the_z_curve_visits_every_pixel_once_in_the_order_of_its_interleaved_bits(height, width):
    def code(number):
        y, x = (f"{n:08b}" for n in divmod(number, width))
        return "".join(a + b for a, b in zip(y, x, strict=True))

    np.testing.assert_array_equal(morton_order(height, width), sorted(range(height * width), key=code))


def test_seeds_are_every_spacing_th_valid_point_along_the_order():
    valid, order = RNG.uniform(size=100) < 0.7, RNG.permutation(100)
    rows, exists = strided_seeds(valid, order, 5, 20)
    rank = np.cumsum(valid[order])[np.argsort(order)]
    assert valid[rows[exists]].all()
    np.testing.assert_array_equal(np.diff(rank[rows[exists]]), 5)
    assert abs(int(exists.sum()) - int(valid.sum()) / 5) <= 1


def test_a_seed_is_in_the_middle_of_the_points_that_it_stands_for():
    places = np.arange(14)
    rows, exists = strided_seeds(np.ones(14, bool), places, 5, 4)
    np.testing.assert_array_equal(rows[:3], [2, 7, 12])  # of 0 to 4, 5 to 9 and 10 to 14
    np.testing.assert_array_equal(exists, [True, True, True, False])
    _, exists = strided_seeds(places < 12, places, 5, 4)
    np.testing.assert_array_equal(exists, [True, True, False, False])  # the third would be the 13th valid point


def test_few_points_make_one_seed_and_none_make_none():
    order = np.arange(50)
    rows, exists = strided_seeds(order == 17, order, 20, 3)
    assert rows[0] == 17
    np.testing.assert_array_equal(exists, [True, False, False])
    _, exists = strided_seeds(np.zeros(50, bool), order, 20, 3)
    assert not exists.any()


def clustered(points, valid, seeds, exists=True, num_iterations=5):
    """With free rows after the points and the seeds, which hold wild values."""

    def filled(rows, count, value):
        rows = np.asarray(rows)
        return np.concatenate([rows, np.full((count - len(rows), *rows.shape[1:]), value, rows.dtype)])

    exists = np.broadcast_to(exists, len(seeds))
    arrays = filled(np.float32(points), NUM_POINTS, 1e6), filled(np.asarray(valid, bool), NUM_POINTS, False)
    found = cluster(
        *arrays, filled(np.float32(seeds), NUM_SEEDS, 0.1), filled(exists, NUM_SEEDS, False), num_iterations
    )
    assert not found[1][len(seeds) :].any()
    return tuple(rows[: len(seeds)] for rows in found)


@pytest.mark.parametrize("num_iterations", [0, 1, 5])
def test_kmeans_equals_lloyd(num_iterations):
    points = RNG.uniform(-1, 1, (NUM_POINTS, 3)).astype(np.float32)
    valid = RNG.uniform(size=NUM_POINTS) < 0.8
    seeds = points[valid][:NUM_SEEDS]
    centroids, exists, counts = clustered(points, valid, seeds, num_iterations=num_iterations)
    expected, expected_counts = reference.lloyd(points[valid].astype(float), seeds, num_iterations)
    np.testing.assert_allclose(centroids, expected, atol=1e-5)  # sums of some 10 offsets below 1 m
    np.testing.assert_array_equal(counts, expected_counts)
    assert exists.all()


def test_an_empty_cluster_stays_where_it_was_and_becomes_invalid():
    points = RNG.uniform(-1, 1, (30, 3)).astype(np.float32)
    centroids, exists, counts = clustered(points, np.ones(30), [points[0], np.full(3, 50.0)])
    np.testing.assert_array_equal(exists, [True, False])
    np.testing.assert_array_equal(counts, [30, 0])
    np.testing.assert_array_equal(centroids[1], [50, 50, 50])
    np.testing.assert_allclose(centroids[0], points.mean(0), atol=1e-6)  # one mean of 30 points
    # Nor does it attract anything any more: it is nearer to the first point than the mean of both.
    centroids, exists, _ = clustered([[0.0, 0, 0], [4, 0, 0]], [1, 1], [[1.0, 0, 0], [-1.5, 0, 0]])
    np.testing.assert_array_equal(exists, [True, False])
    np.testing.assert_array_equal(centroids[:, 0], [2, -1.5])


def test_a_seed_that_does_not_exist_and_invalid_points_attract_nothing():
    points, seeds = [[0.0, 0, 0], [1, 0, 0], [1e6, 1e6, 1e6]], [[0.2, 0, 0], [1, 0, 0]]
    centroids, exists, counts = clustered(points, [1, 1, 0], seeds, [True, False])
    np.testing.assert_allclose(centroids[0], [0.5, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(exists, [True, False])
    np.testing.assert_array_equal(counts, [2, 0])
