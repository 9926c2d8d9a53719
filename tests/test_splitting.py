"""What one Gaussian cannot explain is cut in two, and only where a view comes near enough to show it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import assert_same, device, explained, fresh_map, on_host, random_gaussians, replace, rows_of

from emgs_jax.em import owners
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.splitting import halves, is_too_coarse, split

splitted, too_coarse, halved, owned = (on_host(f) for f in (split, is_too_coarse, halves, owners))
UP = (0.0, 0.0, 1.0)
SPACING, NUM_POINTS = 8, 64


@pytest.fixture(scope="module")
def settings(config):
    return config().splitting


def one_disc(std=(0.2, 0.1, 0.01), weight=6.0) -> GaussianMap:
    """A Gaussian at (1, 2, 3) with normal z, and a free row."""
    covs = np.stack([np.diag(np.square(std)), np.eye(3)])
    arrays = [[1.0, 2, 3], [0, 0, 0]], covs, [[0.5] * 3, [0.0] * 3], [UP, (0, 0, 0)], np.zeros((2, 0)), [True, False]
    return fresh_map(Gaussians(*map(device, arrays)), weight, 2.0, 3)


def points_of(map: GaussianMap, count: int = NUM_POINTS, seed: int = 0) -> Observation:
    """Points on the first Gaussian's plane, of its colour and normal."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * (0.3, 0.15, 0.0) + map.gaussians.means[0]
    arrays = points, np.full((count, 3), 0.5), np.tile(UP, (count, 1)), np.zeros((count, 0)), np.ones(count)
    return Observation(*(device(array) for array in (*arrays, np.ones(count, bool))))


def explained_by_first(count: int, share: float = 1.0):
    """The owners of points of which the first Gaussian explains so many."""
    shares = np.tile([share, 0.0], (NUM_POINTS, 1)) * (np.arange(NUM_POINTS) < count)[:, None]
    arrays = np.tile(np.int32([0, 1]), (NUM_POINTS, 1)), shares, shares[:, 0] > 0
    return owned(explained(*arrays), 2)


def verdict(map, points, settings, noise=0.0, explained=None):
    rays = np.float32(np.tile(noise * np.array(UP), (NUM_POINTS, 1)))
    explained = explained_by_first(NUM_POINTS) if explained is None else explained
    return bool(too_coarse(map.gaussians, points, rays, explained, SPACING, settings)[0])


def is_left(points):
    return np.asarray(points.points)[:, :1] < 1.0


def colored(points):
    """Dark on one side of the middle, bright on the other."""
    return replace(points, colors=np.where(is_left(points), 0.2, 0.8) * np.ones(3))


def bent(points):
    return replace(points, normals=np.where(is_left(points), -1.0, 1.0) * np.array([0.6, 0, 0]) + [0, 0, 0.8])


def stepped(points, height=0.06):
    return replace(points, points=points.points + np.where(is_left(points), -0.5, 0.5) * height * np.array(UP))


@pytest.mark.parametrize("contradict", [colored, bent, stepped])
def test_points_that_contradict_split_and_points_that_agree_do_not(settings, contradict):
    map = one_disc()
    points = points_of(map)
    assert not verdict(map, points, settings)
    assert verdict(map, contradict(points), settings)


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_colour_is_contradicted_from_its_deviation_on(settings, share):
    map, points = one_disc(), points_of(one_disc())
    off = np.where(is_left(points), -share, share) * float(settings.color_std)
    assert verdict(map, replace(points, colors=0.5 + off * np.ones(3)), settings) == (share > 1)


def test_a_view_that_is_no_nearer_than_the_first_splits_nothing(settings):
    map, enough = one_disc(), int(settings.min_points) * SPACING
    for count in (enough - 1, enough):
        explained = explained_by_first(count)
        assert verdict(map, colored(points_of(map)), settings, explained=explained) == (count == enough)


def test_a_spread_within_the_noise_or_a_common_offset_is_no_contradiction(settings):
    map = one_disc()
    points = points_of(map)
    assert not verdict(map, stepped(points), settings, noise=0.05)
    above = replace(points, points=points.points + 0.06 * np.array(UP))
    assert not verdict(map, above, settings)  # a pose's error moves all of them


def test_halves_together_have_the_moments_and_the_weight_of_the_whole():
    map = fresh_map(random_gaussians(20, 3), np.arange(20.0), 1.5, 3)
    whole = rows_of(map.gaussians, slice(None))
    min_std = np.float32(np.sqrt(0.9 * np.linalg.eigvalsh(whole.covs).min()))
    first, second, _ = halved(map, min_std)
    a, b = first.gaussians, second.gaussians
    np.testing.assert_allclose((a.means + b.means) / 2, whole.means, atol=1e-6)
    half = (b.means - a.means) / 2
    np.testing.assert_allclose(a.covs + half[:, :, None] * half[:, None, :], whole.covs, atol=1e-6)
    assert np.linalg.eigvalsh(a.covs).min() >= 0.999 * min_std**2
    np.testing.assert_allclose(first.weight + second.weight, map.weight)
    np.testing.assert_array_equal(second.existence, map.existence)
    across = np.abs(np.sum(half * whole.normals, axis=-1)) / np.linalg.norm(half, axis=-1)
    assert np.median(across) < 0.9


def test_it_is_cut_across_its_longer_axis_as_a_normal_distribution_is(settings):
    floor = float(settings.min_std)
    first, second, _ = halved(one_disc(std=(0.2, 0.1, floor)), settings.min_std)
    shape_sq = 0.2**2 - floor**2
    mean, variance = np.sqrt(2 / np.pi * shape_sq), (1 - 2 / np.pi) * shape_sq  # of one half, along x
    np.testing.assert_allclose(second.gaussians.means[0], [1 + mean, 2, 3], atol=1e-5)
    np.testing.assert_allclose(first.gaussians.means[0], [1 - mean, 2, 3], atol=1e-5)
    np.testing.assert_allclose(second.gaussians.covs[0], np.diag([variance + floor**2, 0.01, floor**2]), atol=1e-6)


def test_halves_of_what_is_thinner_than_the_floor_have_finite_slopes(settings):
    def total(covs):
        return jnp.sum(
            halves(eqx.tree_at(lambda m: m.gaussians.covs, one_disc(), covs), settings.min_std)[1].gaussians.means
        )

    thin = device(np.tile(0.25 * float(settings.min_std) ** 2 * np.eye(3), (2, 1, 1)))
    assert np.isfinite(on_host(jax.grad(total))(thin)).all()


def parted(map, points, settings, explained=None):
    """The map, and the second halves."""
    count = points.valid.shape[0]
    explained = explained_by_first(count) if explained is None else explained
    return splitted(map, points, np.zeros((count, 3), np.float32), explained, SPACING, settings)


def test_what_is_hardly_wider_than_the_floor_stays_one(settings):
    floor = float(settings.min_std)
    map = one_disc(std=(1.2 * floor, 1.1 * floor, floor))
    same, second = parted(map, colored(points_of(map)), settings)
    assert_same(same, map)
    assert not second.gaussians.valid.any()


def test_printed_splits_nothing(config):
    printed = config("slam/splitting=paper").splitting
    map = one_disc()
    same, second = parted(map, colored(points_of(map)), printed)
    assert_same(same, map)
    assert second.weight.shape == (0,)


def test_no_more_than_max_splits_and_the_rest_in_the_next_frames(config):
    """Two discs that are to be cut alike, the first by the even points and the second by the odd ones."""
    settings = config("slam.splitting.max_splits=1").splitting
    both = rows_of(one_disc(), np.array([0, 0]))
    points = colored(points_of(both))
    cut, second = parted(both, points, settings, np.arange(NUM_POINTS, dtype=np.int32) % 2)
    assert second.gaussians.valid.sum() == 1
    np.testing.assert_array_equal(cut.gaussians.means[1], both.gaussians.means[1])
    assert (cut.gaussians.means[0] != both.gaussians.means[0]).any()
