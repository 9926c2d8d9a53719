"""Eq. 1 and the blends of eq. 4 against NumPy, literals, the moments of a mixture, and rigid motions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from scene import (
    as_numpy,
    assert_same,
    at,
    move_gaussians,
    observe_room,
    path_pose,
    pose,
    random_gaussians,
    random_observation,
)

from emgs_jax.gaussians import blend, cluster, color_gradients, empty_gaussians, fit_to_points, intensity, spacing
from emgs_jax.observation import transform
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.clustering import morton_order

pytestmark = pytest.mark.slow  # many small executables: most of the time is compilation

fit, gradients_of = eqx.filter_jit(fit_to_points), eqx.filter_jit(color_gradients)
ONE = jnp.ones(())


@pytest.fixture(scope="module")
def fit_config(config):
    return config("slam.fit.feature=medoid").fit


@pytest.mark.parametrize(("num_features", "num_valid"), [(0, 200), (4, 200), (4, 6)])
def test_fitting_equals_equation_1(fit_config, num_features, num_valid):
    """With six points a centre has fewer than the eight that it asks for."""
    points = random_observation(200, num_features=num_features)
    valid = np.arange(200) % (200 // num_valid) == 0 if num_valid < 200 else np.ones(200, bool)
    points = eqx.tree_at(lambda o: o.valid, points, jnp.asarray(valid & (np.cumsum(valid) <= num_valid)))
    centers = points.points[:20] + 0.02
    fitted = fit(centers, jnp.ones(20, bool), points, fit_config)
    arrays = [np.asarray(x, float) for x in (points.points, points.normals, points.colors, points.features)]
    arrays.append(np.asarray(points.valid))
    assert fitted.valid.all()
    for k, center in enumerate(np.asarray(centers, float)):
        expected = reference.fit_to_points(center, *arrays, fit_config.num_fit_neighbours, float(fit_config.min_std))
        actual = fitted.covs[k], fitted.normals[k], fitted.colors[k], fitted.features[k]
        # float32 inverses of covariances with condition numbers below 100
        for a, b in zip(actual, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-4)
    assert_same(fitted.means, centers)


def test_a_feature_is_one_of_the_points_and_not_their_mean(fit_config):
    points = random_observation(8, num_features=2)
    features = jnp.array([[1.0, 0]] * 3 + [[0.8, 0.6]] * 3 + [[0.0, 1]] * 2)
    positions = jnp.asarray(
        np.random.default_rng(0).normal(size=(8, 3)) * 1e-3, jnp.float32
    )  # equal weights: far below min_std
    points = eqx.tree_at(lambda o: (o.features, o.points), points, (features, positions))
    fitted = fit(jnp.zeros((1, 3)), jnp.ones(1, bool), points, fit_config)
    np.testing.assert_array_equal(fitted.features, [features[3]])


def test_accumulated_evidence_is_the_sum_of_the_points_features_and_a_missing_one_says_nothing(fit_config):
    """Eight points in one place: four say the one, two the other, two nothing."""
    config = at(fit_config, "feature", 1)
    points = random_observation(8, num_features=2)
    features = jnp.array([[1.0, 0]] * 4 + [[0.0, 1]] * 2 + [[0.0, 0]] * 2)
    positions = jnp.asarray(np.random.default_rng(0).normal(size=(8, 3)) * 1e-4 + [0, 0, 2], jnp.float32)
    points = eqx.tree_at(lambda o: (o.features, o.points), points, (features, positions))
    gaussians, _ = eqx.filter_jit(cluster)(points, jnp.arange(8), 8, config)
    np.testing.assert_allclose(gaussians.features, [[4.0, 2.0]], rtol=1e-3)  # equal weights up to e^-1e-4


def test_no_eigenvalue_is_below_the_floor(fit_config, camera):
    points = observe_room(path_pose(0), camera)  # planes: one direction has no spread at all
    fitted = fit(points.points[::40], jnp.ones(20, bool), points, fit_config)
    smallest = np.linalg.eigvalsh(np.asarray(fitted.covs, float))[:, 0]
    floor = float(fit_config.min_std) ** 2
    assert (smallest >= floor * (1 - 1e-3)).all()  # roundings of centimetres squared


@pytest.mark.parametrize(("count", "expected"), [(3, False), (4, True)])
def test_a_centre_with_fewer_than_four_points_is_invalid_and_neutral(fit_config, count, expected):
    points = random_observation(50)
    points = eqx.tree_at(lambda o: o.valid, points, jnp.arange(50) < count)
    fitted = fit(points.points[:2], jnp.array([True, False]), points, fit_config)
    np.testing.assert_array_equal(fitted.valid, [expected, False])
    assert_same(jax.tree.map(lambda x: x[1], fitted), jax.tree.map(lambda x: x[0], empty_gaussians(1, 0)))


@pytest.mark.parametrize("poison", [1e6, -1e6])
def test_invalid_points_change_no_gaussian(fit_config, poison):
    points = random_observation(100, num_features=2)
    points = eqx.tree_at(lambda o: o.valid, points, jnp.arange(100) % 3 > 0)
    bad = jax.tree.map(lambda x: jnp.where(points.valid.reshape(-1, *[1] * (x.ndim - 1)), x, poison), points)
    bad = eqx.tree_at(lambda o: o.valid, bad, points.valid)
    arguments = points.points[1:9:3], jnp.ones(3, bool)
    assert_same(fit(*arguments, bad, fit_config), fit(*arguments, points, fit_config))


def test_fitting_moves_with_a_rigid_motion(fit_config):
    points, T = random_observation(200), pose((0.4, -0.9, 0.3), (0.5, 1.0, -0.7))
    centers = points.points[:20] + 0.02
    moved = fit(
        centers @ T.rotation().as_matrix().T + T.translation(),
        jnp.ones(20, bool),
        transform(T, points, ONE),
        fit_config,
    )
    expected = move_gaussians(T, fit(centers, jnp.ones(20, bool), points, fit_config))
    for a, b in zip(jax.tree.leaves(moved), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=3e-4)  # float32 inverses of covariances; coordinates of 2 m


def test_an_image_is_cut_into_as_many_pieces_whatever_its_size(config):
    chosen = config("slam.fit.points_per_gaussian=128").fit
    for width, height, thin, expected in (
        (518, 392, 1, 128),
        (518, 392, 4, 8),
        (259, 196, 1, 32),
        (259, 196, 2, 8),
        (518, 196, 2, 16),  # half of the image has half of the pieces' pixels
        (130, 98, 2, 4),  # two rows would have no covariance
    ):
        assert spacing(Camera([1.0, 1.0], [0.0, 0.0], width, height), thin, chosen) == expected


def test_clustering_a_room_gives_thin_gaussians_on_its_walls(fit_config, camera):
    T = path_pose(0)
    world = transform(T, observe_room(T, camera), ONE)
    gaussians, weight = eqx.filter_jit(cluster)(world, morton_order(24, 32), 8, fit_config)
    assert gaussians.valid.shape == (96,) and gaussians.valid.all()
    # Every point belongs to one cluster, counted in units of `spacing`.
    np.testing.assert_allclose(weight.sum() * 8, 768, rtol=1e-5)
    means = np.asarray(gaussians.means, float)
    off_wall = np.minimum(np.abs(means - reference.ROOM_LOW), np.abs(means - reference.ROOM_HIGH)).min(axis=1)
    assert np.median(off_wall) < 1e-3  # a cluster within one wall lies on it; those across edges do not
    on_wall = off_wall < 1e-3
    flat = np.einsum(
        "ni,nij,nj->n", *(np.asarray(x, float) for x in (gaussians.normals, gaussians.covs, gaussians.normals))
    )
    assert np.median(flat[on_wall]) < 1.2 * float(fit_config.min_std) ** 2


def test_no_gaussian_spans_a_depth_edge_that_is_larger_than_it(fit_config):
    """A pole of two pixels 1 m away, a wall at 3 m: there is no point between, and no Gaussian reaches across."""
    y, x = np.divmod(np.arange(768), 32)
    is_pole = (x == 15) | (x == 16)
    depth = np.where(is_pole, 1.0, 3.0)
    rays = np.stack([(x - 15.5) / 30, (y - 11.5) / 30, np.ones(768)], axis=-1)
    points = random_observation(768)
    points = eqx.tree_at(lambda o: o.points, points, jnp.asarray(rays * depth[:, None], jnp.float32))
    gaussians, _ = eqx.filter_jit(cluster)(points, morton_order(24, 32), 8, fit_config)
    z, std = gaussians.means[gaussians.valid, 2], jnp.sqrt(gaussians.covs[gaussians.valid, 2, 2])
    is_on_pole = z < 2
    assert len(z) > 90 and 2 <= is_on_pole.sum() <= 8
    np.testing.assert_allclose(z, jnp.where(is_on_pole, 1.0, 3.0), atol=1e-5)
    np.testing.assert_allclose(std, float(fit_config.min_std), rtol=1e-2)


def test_a_gaussian_is_as_large_as_its_cluster_whatever_the_number_of_points_in_it(fit_config):
    """A cluster of n pixels of a plane with pitch a is about a disc of area n a², whose covariance has trace n a² / 2π.

    The eight nearest points of 64 would make it an eighth of that.
    """
    y, x = np.divmod(np.arange(768), 32)
    plane = random_observation(768)
    positions = jnp.asarray(np.stack([0.02 * x, 0.02 * y, 2.0 + 0.0 * x], axis=-1), jnp.float32)
    plane = eqx.tree_at(lambda o: o.points, plane, positions)
    gaussians, _ = eqx.filter_jit(cluster)(plane, morton_order(24, 32), 64, fit_config)
    trace = np.trace(np.asarray(gaussians.covs), axis1=1, axis2=2) - 3 * float(fit_config.min_std) ** 2
    expected = 64 * 0.02**2 / (2 * np.pi)
    assert 0.6 * expected < np.median(trace) < 1.5 * expected


def test_a_handful_of_points_makes_one_gaussian_of_just_these(fit_config, camera):
    """Five valid points of 768: what is not there has no part in eq. 1."""
    points = random_observation(768)
    points = eqx.tree_at(lambda o: o.valid, points, jnp.arange(768) % 170 == 40)
    arrays = [np.asarray(x, float) for x in (points.points, points.normals, points.colors, points.features)]
    valid = np.asarray(points.valid)
    gaussians, weight = eqx.filter_jit(cluster)(points, morton_order(24, 32), 8, fit_config)
    np.testing.assert_array_equal(gaussians.valid, np.arange(96) == 0)
    assert valid.sum() == 5 and weight[0] == 5 / 8
    center = arrays[0][valid].mean(axis=0)
    expected = reference.fit_to_points(center, *arrays, valid, fit_config.num_fit_neighbours, float(fit_config.min_std))
    actual = gaussians.covs[0], gaussians.normals[0], gaussians.colors[0]
    np.testing.assert_allclose(gaussians.means[0], center, atol=1e-5)  # roundings of coordinates of 2 m
    for a, b in zip(actual, expected, strict=False):
        np.testing.assert_allclose(a, b, atol=2e-4)  # as for eq. 1


def test_free_rows_are_neutral():
    rows = empty_gaussians(3, 2)
    np.testing.assert_array_equal(rows.covs, np.tile(np.eye(3), (3, 1, 1)))
    others = rows.means, rows.colors, rows.normals, rows.features, rows.valid
    assert not any(np.asarray(x).any() for x in others) and rows.features.shape == (3, 2)


def test_the_luminance_weighs_red_green_and_blue_as_the_eye_does():
    light = intensity(jnp.eye(3))
    np.testing.assert_allclose(light, [0.299, 0.587, 0.114], rtol=1e-6)  # ITU-R BT.601


@pytest.mark.parametrize("num_valid", [80, 5])
def test_colour_gradients_equal_least_squares_over_the_valid_neighbours(num_valid):
    """With five valid Gaussians each has fewer neighbours than it asks for."""
    g = random_gaussians(80)
    g = eqx.tree_at(lambda g: g.valid, g, jnp.arange(80) % 16 < num_valid / 5)
    numbers = [as_numpy(g)[name] for name in ("means", "normals", "colors", "valid")]
    gradients = np.asarray(gradients_of(g, 12))
    for k in np.flatnonzero(numbers[-1]):
        expected = reference.color_gradient(k, *numbers, 12)
        # float32 inverses of moments whose ridge keeps their condition number below 100
        np.testing.assert_allclose(gradients[k], expected, atol=1e-4 * max(1.0, np.linalg.norm(expected)))


def test_a_linear_intensity_on_a_plane_has_its_gradient_within_the_plane():
    g = random_gaussians(80)
    normal = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
    means = np.asarray(g.means, float)
    means -= (means @ normal)[:, None] * normal
    slope = np.array([0.1, 0.2, -0.1])
    light = 0.5 + means @ slope
    colors = np.tile(light[:, None], (1, 3))  # luminance of grey is grey
    arrays = [jnp.asarray(x, jnp.float32) for x in (means, colors, np.tile(normal, (80, 1)))]
    g = eqx.tree_at(lambda x: (x.means, x.colors, x.normals), g, tuple(arrays))
    gradients = np.asarray(gradients_of(g, 12))
    expected = slope - (slope @ normal) * normal
    np.testing.assert_allclose(gradients @ normal, 0, atol=1e-6)
    # The documented ridge of a hundredth of the spread shrinks the gradient by a few per cent.
    np.testing.assert_allclose(gradients, np.tile(expected, (80, 1)), atol=0.12 * np.linalg.norm(expected))


@pytest.mark.parametrize("moment_matched", [0.0, 1.0])
@pytest.mark.parametrize(("gain", "expected"), [(0.0, "old"), (1.0, "new")])
def test_a_blend_with_gain_0_or_1_is_the_old_or_the_new(gain, expected, moment_matched):
    sets = {"old": random_gaussians(5, 0, 2), "new": random_gaussians(5, 1, 2)}
    blended = blend(sets["old"], sets["new"], jnp.full(5, gain), jnp.asarray(moment_matched))
    for name in ("means", "covs", "colors", "normals"):
        np.testing.assert_allclose(
            getattr(blended, name), getattr(sets[expected], name), atol=1e-6
        )  # old + (new - old)
    assert_same((blended.features, blended.valid), (sets["old"].features, sets["old"].valid))


def test_the_printed_blend_is_linear_in_every_parameter_and_normals_stay_unit():
    old, new = (as_numpy(random_gaussians(6, seed)) for seed in (0, 1))
    gain = np.linspace(0.1, 0.9, 6)
    blended = blend(random_gaussians(6, 0), random_gaussians(6, 1), jnp.asarray(gain, jnp.float32), jnp.zeros(()))
    for name in ("means", "covs", "colors"):
        weight = gain.reshape(-1, *[1] * (old[name].ndim - 1))
        np.testing.assert_allclose(getattr(blended, name), (1 - weight) * old[name] + weight * new[name], atol=1e-6)
    normals = (1 - gain[:, None]) * old["normals"] + gain[:, None] * new["normals"]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(blended.normals, normals, atol=1e-6)  # float32 roundings near 1


def test_the_moment_matched_blend_has_the_moments_of_the_mixture():
    old, new = random_gaussians(4, 0), random_gaussians(4, 1)
    gain = jnp.array([0.1, 0.3, 0.5, 0.8])
    blended = blend(old, new, gain, jnp.ones(()))
    rng = np.random.default_rng(0)
    for k in range(4):
        share = [1 - float(gain[k]), float(gain[k])]
        samples = np.concatenate(
            [
                rng.multivariate_normal(np.asarray(g.means[k], float), np.asarray(g.covs[k], float), round(200_000 * w))
                for g, w in zip((old, new), share, strict=True)
            ]
        )
        scale = np.trace(np.cov(samples.T))
        np.testing.assert_allclose(blended.means[k], samples.mean(0), atol=0.01)  # 4 standard errors of the sample mean
        np.testing.assert_allclose(blended.covs[k], np.cov(samples.T), atol=0.015 * scale)  # likewise
