"""Eq. 1 and the blends of eq. 4 against NumPy, literals, the moments of a mixture, and rigid motions."""

import numpy as np
import pytest
import reference
import scene as sc

from emgs_jax.gaussians import blend, cluster, color_gradients, empty_gaussians, fit_to_points, intensity, spacing
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.clustering import morton_order

fit, gradients_of, clustered, blended = (sc.on_host(f) for f in (fit_to_points, color_gradients, cluster, blend))
NUM_POINTS, NUM_CENTERS, NUM_FEATURES = 200, 20, 4  # of every fit: one program for all
PIXELS, ORDER = 768, np.asarray(morton_order(24, 32))


def some_points(**changes):
    return sc.replace(sc.random_observation(NUM_POINTS, num_features=NUM_FEATURES), **changes)


def filled(rows, count, value=0.0):
    """As many rows, the further ones with another value."""
    rows = np.asarray(rows, float)
    return np.concatenate([rows, np.full((count - len(rows), *rows.shape[1:]), value)])


def fitted_at(centers, points, config, exists=None):
    """The Gaussians of so many centres; all further ones do not exist."""
    exists = np.ones(len(centers), bool) if exists is None else exists
    found = fit(np.float32(filled(centers, NUM_CENTERS)), filled(exists, NUM_CENTERS) > 0, points, config)
    return sc.rows_of(found, slice(len(centers)))


@pytest.fixture(scope="module")
def fit_config(config):
    return config("slam.fit.feature=medoid").fit


@pytest.mark.parametrize("num_valid", [200, 6])
def test_fitting_equals_equation_1(fit_config, num_valid):
    """With six points a centre has fewer than the eight that it asks for."""
    valid = np.arange(200) % (200 // num_valid) == 0
    points = some_points(valid=valid & (np.cumsum(valid) <= num_valid))
    centers = np.asarray(points.points)[:20] + np.float32(0.02)
    fitted = fitted_at(centers, points, fit_config)
    arrays = [np.asarray(x, float) for x in (points.points, points.normals, points.colors, points.features)]
    arrays.append(np.asarray(points.valid))
    assert fitted.valid.all()
    for k, center in enumerate(centers.astype(float)):
        expected = reference.fit_to_points(center, *arrays, fit_config.num_fit_neighbours, float(fit_config.min_std))
        actual = fitted.covs[k], fitted.normals[k], fitted.colors[k], fitted.features[k]
        # float32 inverses of covariances with condition numbers below 100
        for a, b in zip(actual, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-4)
    sc.assert_same(fitted.means, centers)


def eight_points(features, spread=1e-3, depth=0.0):
    """In one place, far below min_std, so that their weights are equal."""
    positions = np.random.default_rng(0).normal(size=(8, 3)) * spread + [0, 0, depth]
    wide = np.concatenate([features, np.zeros((8, NUM_FEATURES - 2))], axis=1)
    return some_points(points=filled(positions, 200), features=filled(wide, 200), valid=np.arange(200) < 8)


def test_accumulated_evidence_is_the_sum_of_the_points_features_and_a_missing_one_says_nothing(fit_config):
    """Eight points in one place: four say the one, two the other, two nothing."""
    points = eight_points(np.array([[1.0, 0]] * 4 + [[0.0, 1]] * 2 + [[0.0, 0]] * 2), 1e-4, 2.0)
    points = sc.rows_of(points, np.minimum(np.arange(PIXELS), 199))
    gaussians, _ = clustered(points, ORDER, 8, sc.at(fit_config, "feature", 1))
    # Equal weights up to e^-1e-4.
    np.testing.assert_allclose(gaussians.features[gaussians.valid], [[4.0, 2.0, 0, 0]], rtol=1e-3)


def test_no_eigenvalue_is_below_the_floor(fit_config, camera):
    room = sc.observe_room(sc.path_pose(0), camera)  # planes: one direction has no spread at all
    points = some_points(points=np.asarray(room.points)[::2][:200])
    fitted = fitted_at(np.asarray(points.points)[::10], points, fit_config)
    smallest = np.linalg.eigvalsh(fitted.covs.astype(float))[:, 0]
    floor = float(fit_config.min_std) ** 2
    assert (smallest >= floor * (1 - 1e-3)).all() and smallest.min() < floor * 1.01  # roundings of squared centimetres


@pytest.mark.parametrize(("count", "expected"), [(3, False), (4, True)])
def test_a_centre_with_fewer_than_four_points_is_invalid_and_neutral(fit_config, count, expected):
    points = some_points(valid=np.arange(200) < count)
    fitted = fitted_at(np.asarray(points.points)[:2], points, fit_config, [True, False])
    np.testing.assert_array_equal(fitted.valid, [expected, False])
    sc.assert_same(sc.rows_of(fitted, 1), sc.rows_of(empty_gaussians(1, NUM_FEATURES), 0))


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
    many = config("slam.fit.points_per_gaussian=100000").fit
    assert spacing(Camera([1.0, 1.0], [0.0, 0.0], 518, 392), 1, many) == 100000  # to the pixel


def test_no_gaussian_spans_a_depth_edge_that_is_larger_than_it(fit_config):
    """A pole of two pixels 1 m away, a wall at 3 m: there is no point between, and no Gaussian reaches across."""
    y, x = np.divmod(np.arange(768), 32)
    is_pole = (x == 15) | (x == 16)
    depth = np.where(is_pole, 1.0, 3.0)
    rays = np.stack([(x - 15.5) / 30, (y - 11.5) / 30, np.ones(768)], axis=-1)
    points = sc.replace(sc.random_observation(PIXELS, num_features=NUM_FEATURES), points=rays * depth[:, None])
    gaussians, _ = clustered(points, ORDER, 8, fit_config)
    z, std = gaussians.means[gaussians.valid, 2], np.sqrt(gaussians.covs[gaussians.valid, 2, 2])
    is_on_pole = z < 2
    assert len(z) > 90 and 2 <= is_on_pole.sum() <= 8
    np.testing.assert_allclose(z, np.where(is_on_pole, 1.0, 3.0), atol=1e-5)
    np.testing.assert_allclose(std, float(fit_config.min_std), rtol=1e-2)


def test_a_gaussian_is_as_large_as_its_cluster_whatever_the_number_of_points_in_it(fit_config):
    """A cluster of n pixels of a plane with pitch a is about a disc of area n a², whose covariance has trace n a² / 2π.

    The eight nearest points of 64 would make it an eighth of that.
    """
    y, x = np.divmod(np.arange(768), 32)
    positions = np.stack([0.02 * x, 0.02 * y, 2.0 + 0.0 * x], axis=-1)
    plane = sc.replace(sc.random_observation(PIXELS), points=positions)
    gaussians, _ = clustered(plane, ORDER, 64, fit_config)
    trace = np.trace(gaussians.covs, axis1=1, axis2=2) - 3 * float(fit_config.min_std) ** 2
    expected = 64 * 0.02**2 / (2 * np.pi)
    assert 0.6 * expected < np.median(trace) < 1.5 * expected


def test_a_handful_of_points_makes_one_gaussian_of_just_these(fit_config):
    """Five valid points of 768: what is not there has no part in eq. 1."""
    points = sc.replace(sc.random_observation(PIXELS, num_features=NUM_FEATURES), valid=np.arange(PIXELS) % 170 == 40)
    arrays = [np.asarray(x, float) for x in (points.points, points.normals, points.colors, points.features)]
    valid = np.asarray(points.valid)
    gaussians, weight = clustered(points, ORDER, 8, fit_config)
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
    light = sc.on_host(intensity)(np.eye(3, dtype=np.float32))
    np.testing.assert_allclose(light, [0.299, 0.587, 0.114], rtol=1e-6)  # ITU-R BT.601


@pytest.mark.parametrize("num_valid", [80, 5])
def test_colour_gradients_equal_least_squares_over_the_valid_neighbours(num_valid):
    """With five valid Gaussians each has fewer neighbours than it asks for."""
    g = sc.replace(sc.random_gaussians(80), valid=np.arange(80) % 16 < num_valid / 5)
    numbers = [sc.as_numpy(g)[name] for name in ("means", "normals", "colors", "valid")]
    gradients = gradients_of(g, 12)
    for k in np.flatnonzero(numbers[-1]):
        expected = reference.color_gradient(k, *numbers, 12)
        # float32 inverses of moments whose ridge keeps their condition number below 100
        np.testing.assert_allclose(gradients[k], expected, atol=1e-4 * max(1.0, np.linalg.norm(expected)))


OLD, NEW = sc.random_gaussians(6, 0, 2), sc.random_gaussians(6, 1, 2)


def between(gain, moment_matched: float):
    return blended(OLD, NEW, np.float32(gain), np.float32(moment_matched))


def test_the_moment_matched_blend_has_the_moments_of_the_mixture():
    """(1 - α) (Σ + d d') + α (Σ' + d' d'') about the common mean, in float64."""
    old, new, gain = sc.as_numpy(OLD), sc.as_numpy(NEW), np.array([0.1, 0.3, 0.5, 0.8, 0.0, 1.0])
    found = between(gain, 1.0)
    means = (1 - gain[:, None]) * old["means"] + gain[:, None] * new["means"]
    np.testing.assert_allclose(found.means, means, atol=1e-6)
    expected = np.zeros((6, 3, 3))
    for share, part in ((1 - gain, old), (gain, new)):
        away = part["means"] - means
        expected += share[:, None, None] * (part["covs"] + away[:, :, None] * away[:, None])
    np.testing.assert_allclose(found.covs, expected, atol=1e-6)


def test_colours_and_normals_blend_by_the_gain_and_features_stay():
    old, new, gain = sc.as_numpy(OLD), sc.as_numpy(NEW), np.array([0.1, 0.3, 0.5, 0.8, 0.0, 1.0])
    found = between(gain, 0.0)
    for name in ("colors", "covs", "normals"):
        share = gain.reshape(6, *[1] * (old[name].ndim - 1))
        expected = (1 - share) * old[name] + share * new[name]
        if name == "normals":
            expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(getattr(found, name), expected, atol=1e-6)
    sc.assert_same(found.features, OLD.features)
