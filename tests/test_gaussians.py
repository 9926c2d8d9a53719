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
    move_gaussians,
    observe_room,
    path_pose,
    pose,
    random_gaussians,
    random_observation,
)

from emgs_jax.gaussians import blend, cluster, empty_gaussians, fit_to_points, spacing
from emgs_jax.observation import transform
from emgs_jax.ops.clustering import morton_order

pytestmark = pytest.mark.slow  # many small executables: most of the time is compilation

fit = eqx.filter_jit(fit_to_points)
ONE = jnp.ones(())


@pytest.fixture(scope="module")
def fit_config(config):
    return config().fit


@pytest.mark.parametrize("num_features", [0, 4])
def test_fitting_equals_equation_1(fit_config, num_features):
    points = random_observation(200, num_features=num_features)
    centers = points.points[:20] + 0.02
    fitted = fit(centers, jnp.ones(20, bool), points, fit_config)
    arrays = [np.asarray(x, float) for x in (points.points, points.normals, points.colors, points.features)]
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


def test_one_gaussian_stands_for_lambda_pixels_of_the_full_image(config):
    for thin, expected in ((1, 128), (2, 32), (4, 8), (16, 1)):
        assert spacing(thin, config("slam.fit.points_per_gaussian=128").fit) == expected


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
