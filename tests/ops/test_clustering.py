"""k-means against Lloyd in NumPy and its limits; seeds and the Z curve against literals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from emgs_jax.ops.clustering import kmeans, morton_order, strided_seeds

cluster = jax.jit(kmeans, static_argnums=4)
RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("height", "width"), [(8, 8), (5, 7), (24, 32), (1, 9), (9, 1), (3, 70)])
def test_the_z_curve_visits_every_pixel_once_in_the_order_of_its_interleaved_bits(height, width):
    def code(number):
        y, x = (f"{n:08b}" for n in divmod(number, width))
        return "".join(a + b for a, b in zip(y, x, strict=True))

    np.testing.assert_array_equal(morton_order(height, width), sorted(range(height * width), key=code))


def test_seeds_are_every_spacing_th_valid_point_along_the_order():
    valid = jnp.asarray(RNG.uniform(size=100) < 0.7)
    order = jnp.asarray(RNG.permutation(100))
    rows, exists = strided_seeds(valid, order, 5, 20)
    rank = np.cumsum(np.asarray(valid)[np.asarray(order)])[np.argsort(np.asarray(order))]
    ranks = rank[np.asarray(rows)[np.asarray(exists)]]
    assert np.asarray(valid)[np.asarray(rows)[np.asarray(exists)]].all()
    np.testing.assert_array_equal(np.diff(ranks), 5)
    assert abs(int(exists.sum()) - int(valid.sum()) / 5) <= 1


def test_a_seed_is_in_the_middle_of_the_points_that_it_stands_for():
    rows, exists = strided_seeds(jnp.ones(14, bool), jnp.arange(14), 5, 4)
    np.testing.assert_array_equal(rows[:3], [2, 7, 12])  # of 0 to 4, 5 to 9 and 10 to 14
    np.testing.assert_array_equal(exists, [True, True, True, False])
    _, exists = strided_seeds(jnp.arange(14) < 12, jnp.arange(14), 5, 3)
    np.testing.assert_array_equal(exists, [True, True, False])  # the third would be the 13th valid point


def test_few_points_make_one_seed_and_none_make_none():
    order = jnp.arange(50)
    rows, exists = strided_seeds(order == 17, order, 20, 3)
    assert rows[0] == 17
    np.testing.assert_array_equal(exists, [True, False, False])
    _, exists = strided_seeds(jnp.zeros(50, bool), order, 20, 3)
    assert not exists.any()


@pytest.mark.parametrize("num_iterations", [0, 1, 5])
def test_kmeans_equals_lloyd(num_iterations):
    points = RNG.uniform(-1, 1, (150, 3)).astype(np.float32)
    valid = RNG.uniform(size=150) < 0.8
    seeds = points[valid][:12]
    centroids, exists, counts = cluster(points, valid, seeds, np.ones(12, bool), num_iterations)
    expected, expected_counts = reference.lloyd(points[valid].astype(float), seeds, num_iterations)
    np.testing.assert_allclose(centroids, expected, atol=1e-5)  # sums of some 10 offsets below 1 m
    np.testing.assert_array_equal(counts, expected_counts)
    assert exists.all()


def test_with_a_seed_on_every_point_the_points_are_the_centroids():
    points = jnp.asarray(RNG.uniform(-1, 1, (40, 3)), jnp.float32)
    centroids, exists, counts = cluster(points, np.ones(40, bool), points, np.ones(40, bool), 4)
    np.testing.assert_array_equal(centroids, points)
    assert exists.all()
    np.testing.assert_array_equal(counts, 1)


def test_an_empty_cluster_stays_where_it_was_and_becomes_invalid():
    points = jnp.asarray(RNG.uniform(-1, 1, (30, 3)), jnp.float32)
    seeds = jnp.stack([points[0], jnp.full(3, 50.0)])
    centroids, exists, counts = cluster(points, np.ones(30, bool), seeds, np.ones(2, bool), 3)
    np.testing.assert_array_equal(exists, [True, False])
    np.testing.assert_array_equal(counts, [30, 0])
    np.testing.assert_array_equal(centroids[1], [50, 50, 50])
    np.testing.assert_allclose(centroids[0], points.mean(0), atol=1e-6)  # one mean of 30 points


def test_a_seed_that_does_not_exist_and_invalid_points_attract_nothing():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1e6, 1e6, 1e6]], np.float32)
    seeds = np.array([[0.2, 0, 0], [1, 0, 0]], np.float32)
    centroids, exists, counts = cluster(points, np.array([1, 1, 0], bool), seeds, np.array([1, 0], bool), 2)
    np.testing.assert_allclose(centroids[0], [0.5, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(exists, [True, False])
    np.testing.assert_array_equal(counts, [2, 0])
