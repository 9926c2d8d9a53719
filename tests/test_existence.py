"""What is seen through goes and what is seen stays; two layers of a surface become one, and two surfaces do not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import assert_same, at, pose

from emgs_jax.existence import depth_range, join_layers, judge, merge_layers, usefulness
from emgs_jax.gaussian_map import GaussianMap, confirmed, new_map
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera, pixel_grid, rays
from emgs_jax.ops.pytree import take_rows

judged = eqx.filter_jit(judge)
CAMERA = Camera([40.0, 44.0], [31.5, 23.5], 64, 48)
NOISE = jnp.asarray(0.02)
HERE = pose()


@pytest.fixture(scope="module")
def settings(config):
    return config().existence


def discs(means, normal=(0.0, 0.0, -1.0), std=0.05, features=None) -> Gaussians:
    """Flat round Gaussians."""
    means = jnp.atleast_2d(jnp.asarray(means, jnp.float32))
    count, normal = len(means), jnp.asarray(normal, jnp.float32)
    cov = std**2 * (jnp.eye(3) - jnp.outer(normal, normal)) + 0.003**2 * jnp.eye(3)
    features = jnp.zeros((count, 0)) if features is None else jnp.asarray(features, jnp.float32)
    return Gaussians(
        means=means,
        covs=jnp.tile(cov, (count, 1, 1)),
        colors=jnp.full((count, 3), 0.5, jnp.float32),
        normals=jnp.tile(normal, (count, 1)),
        features=features,
        valid=jnp.ones(count, bool),
    )


def map_of(*parts: Gaussians, existence=0.5, weight=1.0) -> GaussianMap:
    gaussians = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    one = jnp.ones(gaussians.valid.shape[0])
    return new_map(gaussians, weight * one, jnp.asarray(existence), jnp.asarray(0))


@eqx.filter_jit
def joined(map: GaussianMap, is_seen, T_world_camera, depth_noise, settings) -> GaussianMap:
    """After one look."""
    return join_layers(map, is_seen, T_world_camera.translation(), depth_noise, settings)


def used(map: GaussianMap):
    """As if the frame had been fused into every Gaussian; negated, into none of them."""
    return jnp.ones(map.existence.shape, jnp.int32)


def look(depth, valid=True) -> Observation:
    """What a camera at the origin sees of a depth image (h, w)."""
    depth = jnp.broadcast_to(jnp.asarray(depth, jnp.float32), (CAMERA.height, CAMERA.width))
    points = (rays(CAMERA, pixel_grid(CAMERA)) * depth[..., None]).reshape(-1, 3)
    count = len(points)
    normals = jnp.tile(jnp.array([0.0, 0, -1]), (count, 1))
    valid = jnp.broadcast_to(jnp.asarray(valid), depth.shape).reshape(-1)
    return Observation(points, jnp.full((count, 3), 0.5), normals, jnp.zeros((count, 0)), jnp.ones(count), valid)


WALL = [(x, y, 3.0) for x in np.arange(-1.8, 1.81, 0.1) for y in np.arange(-1.2, 1.21, 0.1)]
SLAB = [(x, y, 2.0) for x in np.arange(-0.5, 0.51, 0.1) for y in np.arange(-0.5, 0.51, 0.1)]
POLE = [(0.9, y, 1.5) for y in np.arange(-0.6, 0.61, 0.05)]


def test_a_slab_before_a_mapped_wall_goes_within_20_looks_and_wall_and_pole_stay(settings):
    """However often the slab was seen before. The pole is two pixels wide and the pose one pixel off."""
    map = map_of(discs(WALL), discs(SLAB), discs(POLE, std=0.02), existence=float(settings.max_log_odds))
    depth = np.full((CAMERA.height, CAMERA.width), 3.0)
    column = round(40.0 * 0.9 / 1.5 + 31.5)
    depth[:, column + 1 : column + 3] = 1.5  # from its second column on, as a turn by 1.4 degrees would show it
    rng = np.random.default_rng(0)
    for _ in range(20):
        noisy = depth * np.exp(0.02 * rng.normal(size=depth.shape))
        map, _ = judged(map, used(map), look(noisy), HERE, CAMERA, NOISE, settings)
    wall, slab, pole = np.split(np.asarray(map.gaussians.valid), [len(WALL), len(WALL) + len(SLAB)])
    assert not slab.any() and wall.mean() >= 0.99 and pole.all()
    assert_same(jax.tree.map(lambda x: x[len(WALL)], map.gaussians).means, jnp.zeros(3))  # the row is free


def test_a_fresh_wrong_gaussian_goes_sooner_and_one_that_explains_is_confirmed(settings):
    map = map_of(discs([(0, 0, 3.0), (0.2, 0, 1.5)]), existence=float(settings.birth))
    assert not confirmed(map).valid.any()
    map, is_seen = judged(map, used(map), look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(is_seen, [True, False])
    np.testing.assert_array_equal(confirmed(map).valid, [True, False])
    np.testing.assert_allclose(map.existence, [settings.hit, -settings.miss])
    for _ in range(5):
        map, _ = judged(map, used(map), look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(map.gaussians.valid, [True, False])
    for _ in range(9):
        map, _ = judged(map, used(map), look(3.0), HERE, CAMERA, NOISE, settings)
    assert map.existence[0] == settings.max_log_odds


def test_what_is_on_the_surface_and_explains_nothing_goes_but_what_a_view_from_afar_cannot_resolve(settings):
    """All at one place, the first four tentative: of no use, and so small, of use, not in the submap; then confirmed
    ones of no use: as wide as a pixel (3 m / 40), and a little less."""
    birth, pixel = float(settings.birth), 3.0 / 40.0
    stds = 0.05, 0.1, 0.1, 0.1, 1.01 * pixel, 0.99 * pixel
    map = map_of(*(discs((0, 0, 3.0), std=std) for std in stds))
    known = [birth] * 4 + [0.1] * 2
    map = eqx.tree_at(lambda m: m.existence, map, jnp.array(known))
    use = jnp.array([-1, -1, 1, 0, -1, -1])
    after, is_seen = judged(map, use, look(3.0), HERE, CAMERA, NOISE, settings)
    assert is_seen.all()
    change = np.array([-settings.miss, -settings.miss, settings.hit, 0.0, -settings.miss, 0.0])
    np.testing.assert_allclose(after.existence, known + change, atol=1e-6)
    for _ in range(9):
        after, _ = judged(after, use, look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(after.gaussians.valid, [False, False, True, True, False, True])


@pytest.mark.parametrize("use", [-1, 0, 1])
@pytest.mark.parametrize("place", ["hidden", "flat", "edge"])
def test_what_shows_nothing_is_confirmed_by_what_it_explains_and_by_nothing_else(settings, place, use):
    """Behind the wall; a floor in a flat look; and between the two depths of an edge."""
    depth, mean, normal = 3.0, (0, 0, 4.0), (0, 0, -1.0)
    if place == "flat":
        mean, normal = (0, 0, 3.0), (0, np.sqrt(1 - 0.1**2), -0.1)
    if place == "edge":
        depth, mean = np.where(np.arange(CAMERA.width) < CAMERA.width // 2, 2.0, 4.0), (0, 0, 3.0)
    map = map_of(discs(mean, normal), existence=-1.0)
    after, is_seen = judged(map, jnp.array([use]), look(depth), HERE, CAMERA, NOISE, settings)
    assert not is_seen.any()
    np.testing.assert_allclose(after.existence, [-1.0 + (settings.hit if use > 0 else 0.0)], atol=1e-6)


def test_what_is_seen_through_is_not_confirmed_by_what_it_explains(settings):
    map = map_of(discs((0, 0, 2.0)))
    after, _ = judged(map, used(map), look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_allclose(after.existence, map.existence - settings.miss, atol=1e-6)


def test_usefulness_is_what_a_frame_fused_into_each_row_of_its_submap():
    map = map_of(discs(WALL[:5]))
    rows = jnp.array([3, 1, 5])  # the last is padding
    submap = take_rows(map, rows)
    submap = eqx.tree_at(lambda m: m.num_updates, submap, submap.num_updates + jnp.array([2, 0, 1]))
    np.testing.assert_array_equal(usefulness(map, submap, rows), [0, -1, 0, 1, 0])


EDGE = jnp.where(jnp.arange(CAMERA.width) < 32, 1.5, 3.0)
SILENT = {
    "occluded": ((0.0, 0.0, 4.0), (0, 0, -1.0), 3.0, True),
    "outside the image": ((4.0, 0.0, 2.0), (0, 0, -1.0), 3.0, True),
    "behind the camera": ((0.0, 0.0, -2.0), (0, 0, -1.0), 3.0, True),
    "no depth there": ((0.0, 0.0, 2.0), (0, 0, -1.0), 3.0, False),
    "grazing": ((0.0, 0.0, 2.0), (1.0, 0, 0), 3.0, True),
    "beside the edge of what hides it": ((0.03, 0.0, 2.0), (0, 0, -1.0), EDGE, True),
}


@pytest.mark.parametrize("reason", SILENT)
def test_a_look_that_says_nothing_changes_nothing(settings, reason):
    mean, normal, depth, valid = SILENT[reason]
    map = map_of(discs(mean, normal, std=0.02), existence=-1.9)
    after, is_seen = judged(map, -used(map), look(depth, valid), HERE, CAMERA, NOISE, settings)
    assert_same(after, map)
    assert not is_seen.any()


@pytest.mark.parametrize(
    ("offset", "of_use", "of_none"), [(-0.25, -1, -1), (-0.15, 1, -1), (0.15, 1, -1), (0.25, 1, 0)]
)
def test_three_standard_deviations_decide(settings, offset, of_use, of_none):
    """Two percent of 3 m and 3 mm of the Gaussian: 3σ = 18 cm; a pixel and its neighbours differ by nothing."""
    map = map_of(discs((0, 0, 3.0 + offset)), existence=0.0)
    for use, change in ((1, of_use), (-1, of_none)):
        after, _ = judged(map, use * used(map), look(3.0), HERE, CAMERA, NOISE, settings)
        np.testing.assert_allclose(after.existence, {-1: -settings.miss, 0: 0.0, 1: settings.hit}[change])


def test_depth_range_is_of_the_pixel_and_its_neighbours():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0)
    depth[10, 20], depth[30, 40] = 1.0, 5.0
    valid = np.ones_like(depth, bool)
    valid[30, 41] = False
    near, far = np.asarray(depth_range(look(depth, valid), HERE, CAMERA)).reshape(2, *depth.shape)
    assert near[9, 19] == 1 and near[11, 21] == 1 and near[12, 20] == 2 and far[9, 19] == 2
    assert far[31, 41] == 5 and far[30, 39] == 5 and near[30, 40] == 2
    assert np.isnan(near[30, 41]) and np.isnan(far[30, 41])


def test_two_sheets_of_a_wall_become_one_and_it_is_no_thicker(settings):
    """5 cm apart at 3 m, where a look has 6 cm of noise: the mean by weight, and half as many Gaussians."""
    front, back = discs([(x, y, 2.95) for x, y, _ in WALL[::4]]), discs([(x, y, 3.0) for x, y, _ in WALL[::4]])
    count = front.valid.shape[0]
    map = map_of(front, back)
    map = eqx.tree_at(lambda m: m.weight, map, jnp.repeat(jnp.array([1.0, 3.0]), count))
    map = eqx.tree_at(lambda m: m.existence, map, jnp.repeat(jnp.array([0.5, 2.0]), count))
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    kept = np.asarray(after.gaussians.valid)
    assert not kept[:count].any() and kept[count:].all()  # the heavier row stays
    means, covs = np.asarray(after.gaussians.means)[kept], np.asarray(after.gaussians.covs)[kept]
    np.testing.assert_allclose(means[:, 2], 2.9875, atol=1e-5)
    np.testing.assert_allclose(covs[:, 2, 2], 0.003**2, rtol=1e-3)
    np.testing.assert_allclose(after.weight[count:], 4.0)
    assert (after.existence[count:] == 2).all() and (after.num_updates[count:] == 2).all()
    again = joined(after, after.gaussians.valid, HERE, NOISE, settings)
    assert_same(again, after)  # what is joined stays as it is


def test_the_covariance_grows_by_the_spread_along_the_surface(settings):
    map = map_of(discs([(0.0, 0, 2.0), (0.04, 0, 2.0)]))
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    assert after.gaussians.valid.sum() == 1
    row = int(np.argmax(np.asarray(after.gaussians.valid)))
    expected = np.diag([0.05**2 + 0.003**2 + 0.02**2, 0.05**2 + 0.003**2, 0.003**2])
    np.testing.assert_allclose(after.gaussians.covs[row], expected, atol=1e-7)
    np.testing.assert_allclose(after.gaussians.means[row], [0.02, 0, 2.0], atol=1e-6)


APART = {
    "beside each other": (discs([(0, 0, 2.0), (0.12, 0, 2.0)]), True, 0.02),
    "two surfaces": (discs([(0, 0, 2.0), (0, 0, 2.2)]), True, 0.02),
    "a precise look": (discs([(0, 0, 2.0), (0, 0, 2.05)]), True, 0.005),
    "not seen": (discs([(0, 0, 2.0), (0, 0, 2.02)]), False, 0.02),
    "two meanings": (discs([(0, 0, 2.0), (0, 0, 2.02)], features=[(1.0, 0), (0, 1.0)]), True, 0.02),
}


@pytest.mark.parametrize("reason", APART)
def test_what_a_look_can_tell_apart_is_not_joined(settings, reason):
    gaussians, seen, noise = APART[reason]
    map = map_of(gaussians)
    after = joined(map, map.gaussians.valid & jnp.asarray([True, seen]), HERE, jnp.asarray(noise), settings)
    assert_same(after, map)


SHEETS = {  # positions, weights, whether they are one surface to a look with 4 cm of noise
    "half a spacing apart along the wall": ([(0, 0, 2.0), (0.05, 0, 2.06)], (2.0, 2.0), True),
    "two that many frames made": ([(0, 0, 2.0), (0.05, 0, 2.06)], (50.0, 50.0), False),
    "one that many frames made": ([(0, 0, 2.0), (0.05, 0, 2.055)], (50.0, 2.0), True),
    "neighbours of one sheet": ([(0, 0, 2.0), (0.09, 0, 2.004)], (2.0, 2.0), False),
    "far behind": ([(0, 0, 2.0), (0, 0, 2.1)], (2.0, 2.0), False),
}


@pytest.mark.parametrize("case", SHEETS)
def test_two_sheets_are_one_where_the_frames_that_made_them_may_differ_so_much(settings, case):
    """d² = δ'(Σ_a + Σ_b + ν² (1/W_a + 1/W_b) nn')⁻¹δ < 4.6: about .5 along the wall, and 2.2, 44 and 3.6 across it."""
    positions, weights, is_one = SHEETS[case]
    map = eqx.tree_at(lambda m: m.weight, map_of(discs(positions)), jnp.array(weights))
    after = joined(map, map.gaussians.valid, HERE, jnp.asarray(0.02), settings)
    assert (after.gaussians.valid.sum() == 1) == is_one
    if is_one:
        np.testing.assert_allclose(after.gaussians.covs[0, 2, 2], 0.003**2, rtol=1e-3)
    else:
        assert_same(after, map)


def test_both_sides_of_a_panel_are_two_surfaces_and_a_missing_feature_says_nothing(settings):
    both = [discs((0, 0, 2.0)), discs((0, 0, 2.02), normal=(0.0, 0, 1.0))]
    map = map_of(*both)
    assert_same(joined(map, map.gaussians.valid, HERE, NOISE, settings), map)
    unlabelled = map_of(discs([(0, 0, 2.0), (0, 0, 2.02)], features=[(1.0, 0), (0, 0.0)]))
    assert joined(unlabelled, unlabelled.gaussians.valid, HERE, NOISE, settings).gaussians.valid.sum() == 1


@pytest.mark.parametrize(("reading", "expected"), [(0.0, [1.0, 0.0]), (1.0, [4.0, 1.0])])
def test_the_evidence_of_both_layers_is_that_of_the_one_as_far_as_evidence_accumulates(settings, reading, expected):
    map = map_of(discs([(0, 0, 2.0), (0, 0, 2.02)], features=[(1.0, 0), (3.0, 1.0)]))
    after = joined(map, map.gaussians.valid, HERE, NOISE, at(settings, "feature", reading))
    np.testing.assert_array_equal(after.gaussians.features[np.asarray(after.gaussians.valid)], [expected])


def test_of_three_layers_the_two_that_chose_each_other_become_one(settings):
    map = map_of(discs([(0, 0, 2.0), (0, 0, 2.01), (0, 0, 2.035)]))
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    np.testing.assert_array_equal(after.gaussians.valid, [True, False, True])  # of equal weights, the first row
    np.testing.assert_allclose(after.gaussians.means[::2, 2], [2.005, 2.035], atol=1e-6)


def test_nothing_stands_behind_what_is_itself_as_thick(settings):
    """Layers of 20, 3 and 20 mm at 3, 3.038 and 2.94 m: of the first and the second neither is a sheet behind."""
    map = map_of(discs([(0, 0, 3.0), (0, 0, 3.038), (0, 0, 2.94)]))
    thickness = jnp.array([0.02, 0.003, 0.02])
    map = eqx.tree_at(lambda m: m.gaussians.covs, map, map.gaussians.covs.at[:, 2, 2].set(thickness**2))
    after = joined(map, map.gaussians.valid, HERE, jnp.asarray(0.01), settings)
    np.testing.assert_array_equal(after.gaussians.valid, [True, True, False])
    np.testing.assert_allclose(after.gaussians.means[:2, 2], [2.97, 3.038], atol=1e-6)


def test_layers_of_visits_that_moved_become_one_though_nobody_looks(settings):
    """Two sheets of a wall 4 cm apart and a third one 4 cm behind, seen from 3 m; one seen from beside stays."""
    wall = WALL[::4]
    sheets = [[(x, y, 3.0 + 0.04 * k) for x, y, _ in wall] for k in range(3)]
    map = map_of(*(discs(sheet) for sheet in sheets), discs([(5.0, 0, 3.0), (5.0, 0, 3.04)]))
    count, origins = len(wall), jnp.zeros((3 * len(wall) + 2, 3)).at[-2:].set(jnp.array([8.0, 0, 3.0]))
    after = eqx.filter_jit(merge_layers)(map, origins, NOISE, settings)
    assert after.gaussians.valid[: 3 * count].sum() == count and after.gaussians.valid[-2:].all()
    kept = np.asarray(after.gaussians.valid).copy()
    kept[-2:] = False
    np.testing.assert_allclose(after.gaussians.means[kept, 2], 3.04, atol=0.021)
    np.testing.assert_allclose(after.gaussians.covs[kept, 2, 2], 0.003**2, rtol=1e-3)  # no thicker
    np.testing.assert_allclose(after.weight[kept], 3.0)
    assert_same(eqx.filter_jit(merge_layers)(after, origins, NOISE, settings), after)


def test_as_printed_nothing_changes_by_a_bit(config):
    printed = config("slam/existence=paper").existence
    map = map_of(discs(WALL), discs(SLAB), existence=float(printed.birth))
    after, is_seen = judged(map, -used(map), look(3.0), HERE, CAMERA, NOISE, printed)
    assert_same(after, map)
    assert is_seen[: len(WALL)].any()  # it looks, but draws no conclusion
    assert_same(joined(map, is_seen, HERE, NOISE, printed), map)
    assert_same(eqx.filter_jit(merge_layers)(map, jnp.zeros((len(is_seen), 3)), NOISE, printed), map)
    assert confirmed(map).valid.all()


def test_a_frame_that_is_not_tracked_says_nothing(settings):
    map = map_of(discs(WALL), discs(SLAB), existence=-1.9)
    after, is_seen = judged(map, -used(map), look(3.0, valid=False), HERE, CAMERA, jnp.asarray(0.0), settings)
    assert_same(after, map)
    assert not is_seen.any()
