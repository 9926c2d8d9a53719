"""What one Gaussian cannot explain is cut in two, and only where a view comes near enough to show it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import assert_same, random_gaussians

from emgs_jax.em import EStep, em_update, owners
from emgs_jax.gaussian_map import GaussianMap, insert, new_map
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.splitting import halves, is_too_coarse, split

splitted, too_coarse, fused = (eqx.filter_jit(f) for f in (split, is_too_coarse, em_update))
UP = (0.0, 0.0, 1.0)
SPACING = 8


@pytest.fixture(scope="module")
def settings(config):
    return config().splitting


def one_disc(std=(0.2, 0.1, 0.01), weight=6.0) -> GaussianMap:
    """A Gaussian at (1, 2, 3) with normal z, and a free row."""
    one = Gaussians(
        means=jnp.array([[1.0, 2, 3], [0, 0, 0]]),
        covs=jnp.stack([jnp.diag(jnp.array(std) ** 2), jnp.eye(3)]),
        colors=jnp.array([[0.5, 0.5, 0.5], [0, 0, 0]]),
        normals=jnp.array([UP, (0, 0, 0)]),
        features=jnp.zeros((2, 0)),
        valid=jnp.array([True, False]),
    )
    return new_map(one, jnp.full(2, weight), jnp.asarray(2.0), jnp.asarray(3))


def points_of(map: GaussianMap, count: int = 64, seed: int = 0) -> Observation:
    """Points on the first Gaussian's plane, of its colour and normal."""
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(-1, 1, (count, 3)) * (0.3, 0.15, 0.0)
    return Observation(
        points=jnp.asarray(offsets, jnp.float32) + map.gaussians.means[0],
        colors=jnp.full((count, 3), 0.5),
        normals=jnp.tile(jnp.array(UP), (count, 1)),
        features=jnp.zeros((count, 0)),
        confidence=jnp.ones(count),
        valid=jnp.ones(count, bool),
    )


def explained_by_first(count: int, share: float = 1.0):
    rows, shares = jnp.tile(jnp.array([[0, 1]]), (count, 1)), jnp.tile(jnp.array([[share, 0.0]]), (count, 1))
    return owners(EStep(rows, shares, shares[:, 0] > 0), 2)


def verdict(map, points, settings, noise=0.0, explained=None):
    count = len(points.valid)
    rays = jnp.tile(noise * jnp.array(UP), (count, 1))
    explained = explained_by_first(count) if explained is None else explained
    return bool(too_coarse(map.gaussians, points, rays, explained, SPACING, settings)[0])


def with_(seen: Observation, **leaves) -> Observation:
    for name, values in leaves.items():
        seen = eqx.tree_at(lambda o: getattr(o, name), seen, values)  # noqa: B023
    return seen


def colored(points):
    """Dark on one side of the middle, bright on the other."""
    is_left = points.points[:, :1] < 1.0
    return with_(points, colors=jnp.broadcast_to(jnp.where(is_left, 0.2, 0.8), points.colors.shape))


def bent(points):
    tilt = jnp.where(points.points[:, :1] < 1.0, -1.0, 1.0) * jnp.array([0.6, 0, 0]) + jnp.array([0, 0, 0.8])
    return with_(points, normals=tilt)


def stepped(points, height=0.06):
    is_left = points.points[:, :1] < 1.0
    return with_(points, points=points.points + jnp.where(is_left, -0.5, 0.5) * height * jnp.array(UP))


@pytest.mark.parametrize("contradict", [colored, bent, stepped])
def test_points_that_contradict_split_and_points_that_agree_do_not(settings, contradict):
    map = one_disc()
    points = points_of(map)
    assert not verdict(map, points, settings)
    assert verdict(map, contradict(points), settings)


def test_a_view_that_is_no_nearer_than_the_first_splits_nothing(settings):
    map = one_disc()
    few = colored(points_of(map, count=int(settings.min_points) * SPACING - 1))
    assert not verdict(map, few, settings)
    enough = colored(points_of(map, count=int(settings.min_points) * SPACING))
    assert verdict(map, enough, settings)


def test_points_that_nothing_explains_are_nobodys(settings):
    map = one_disc()
    points = colored(points_of(map))
    assert not verdict(map, points, settings, explained=explained_by_first(len(points.valid), 0.0))


def test_a_spread_within_the_noise_or_a_common_offset_is_no_contradiction(settings):
    map = one_disc()
    points = points_of(map)
    assert not verdict(map, stepped(points), settings, noise=0.05)
    above = with_(points, points=points.points + 0.06 * jnp.array(UP))
    assert not verdict(map, above, settings)  # a pose's error moves all of them


def test_halves_together_have_the_moments_and_the_weight_of_the_whole():
    map = new_map(random_gaussians(20, 3), jnp.arange(20.0), jnp.asarray(1.5), jnp.asarray(3))
    min_std = jnp.sqrt(0.9 * jnp.min(jnp.linalg.eigvalsh(map.gaussians.covs)))
    first, second, _ = halves(map, min_std)
    a, b, whole = first.gaussians, second.gaussians, map.gaussians
    np.testing.assert_allclose((a.means + b.means) / 2, whole.means, atol=1e-6)
    half = (b.means - a.means) / 2
    covs = a.covs + half[:, :, None] * half[:, None, :]
    np.testing.assert_allclose(covs, whole.covs, atol=1e-6 * float(jnp.max(whole.covs)) + 1e-7)
    assert jnp.min(jnp.linalg.eigvalsh(a.covs)) >= 0.999 * min_std**2
    np.testing.assert_allclose(first.weight + second.weight, map.weight)
    np.testing.assert_array_equal(second.existence, map.existence)
    across = jnp.abs(jnp.sum(half * whole.normals, axis=-1)) / jnp.linalg.norm(half, axis=-1)
    assert jnp.median(across) < 0.9


def test_it_is_cut_across_its_longer_axis_as_a_normal_distribution_is(settings):
    map = one_disc(std=(0.2, 0.1, float(settings.min_std)))
    first, second, _ = halves(map, settings.min_std)
    rng = np.random.default_rng(0)
    shape = np.sqrt(0.2**2 - float(settings.min_std) ** 2)
    samples = np.abs(rng.normal(size=200_000)) * shape  # of one half, along x
    np.testing.assert_allclose(second.gaussians.means[0], [1 + samples.mean(), 2, 3], atol=2e-3)
    np.testing.assert_allclose(first.gaussians.means[0], [1 - samples.mean(), 2, 3], atol=2e-3)
    variance = samples.var() + float(settings.min_std) ** 2
    np.testing.assert_allclose(
        second.gaussians.covs[0], np.diag([variance, 0.01, float(settings.min_std) ** 2]), atol=2e-4
    )


def test_what_is_hardly_wider_than_the_floor_stays_one(settings):
    floor = float(settings.min_std)
    map = one_disc(std=(1.2 * floor, 1.1 * floor, floor))
    points = colored(points_of(map))
    same, second = splitted(map, points, jnp.zeros((64, 3)), explained_by_first(64), SPACING, settings)
    assert_same(same, map)
    assert not second.gaussians.valid.any()


def test_printed_splits_nothing(config):
    printed = config("slam/splitting=paper").splitting
    map = one_disc()
    same, second = splitted(map, colored(points_of(map)), jnp.zeros((64, 3)), explained_by_first(64), SPACING, printed)
    assert_same(same, map)
    assert second.weight.shape == (0,)


def test_no_more_than_max_splits_and_the_rest_in_the_next_frames(config):
    settings = config("slam.splitting.max_splits=1").splitting
    map = one_disc()
    both = jax.tree.map(lambda leaf: jnp.stack([leaf[0], leaf[0]]), map)
    points = colored(points_of(map))
    rows = jnp.concatenate([jnp.zeros(64, jnp.int32), jnp.ones(64, jnp.int32)])
    points = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), points)
    cut, second = splitted(both, points, jnp.zeros((128, 3)), rows, SPACING, settings)
    assert second.gaussians.valid.sum() == 1
    np.testing.assert_array_equal(cut.gaussians.means[1], both.gaussians.means[1])
    assert (cut.gaussians.means[0] != both.gaussians.means[0]).any()


def frames_of_a_checkerboard(config, splitting, num_frames=12):
    """A coarse Gaussian of a board of 4 × 2 squares, then near views: the map's colour error at the board's points."""
    map = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], jnp.repeat(leaf[1:], 95, axis=0)]), one_disc(weight=1.0))
    points = points_of(map, count=1200)
    squares = jnp.floor((points.points[:, :2] - map.gaussians.means[0, :2]) / 0.15).astype(jnp.int32).sum(-1) % 2
    points = with_(points, colors=jnp.broadcast_to(0.2 + 0.6 * squares[:, None], (1200, 3)).astype(jnp.float32))
    noise = jnp.zeros((1200, 3))
    counts = []
    for _ in range(num_frames):
        map, step, _ = fused(map, points, noise, config.em)
        map, second = splitted(map, points, noise, owners(step, 96), SPACING, splitting)
        map, _, overflow = insert(map, second)
        assert overflow == 0
        counts.append(int(map.gaussians.valid.sum()))
    _, step, _ = fused(map, points, noise, config.em)
    shown = jnp.einsum("mk,mkc->mc", step.responsibilities, map.gaussians.colors[step.rows])
    return counts, float(jnp.mean(jnp.abs(shown - points.colors)[step.is_fused]))


def test_a_checkerboard_seen_near_becomes_its_squares_and_then_no_more(config):
    whole, settings = config("slam.em.num_neighbours=8"), config().splitting
    _, blurred = frames_of_a_checkerboard(whole, config("slam/splitting=paper").splitting)
    counts, sharp = frames_of_a_checkerboard(whole, settings)
    assert sharp < 0.6 * blurred
    assert counts[-1] == counts[-4] and 6 <= counts[-1] <= 2 * 1200 / (settings.min_points * SPACING)
