"""What is seen through goes and what is seen stays; two layers of a surface become one, and two surfaces do not."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scene import assert_same, at, device, flat_gaussians, fresh_map, join, on_host, pose, replace, rows_of

from emgs_jax.existence import (
    Look,
    Seen,
    depth_range,
    fusion_evidence,
    merge_all_duplicates,
    merge_duplicates,
    take_back,
    update_existence,
)
from emgs_jax.gaussian_map import GaussianMap, confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera

NUM_ROWS = 1200  # of every map, most of them free: one program for all
judged_map, corrected_map, joined_map, merged_map, ranges = (
    on_host(f) for f in (update_existence, take_back, merge_duplicates, merge_all_duplicates, depth_range)
)
CAMERA = Camera([40.0, 44.0], [31.5, 23.5], 64, 48)
NOISE = device(0.02)
HERE = pose()


@pytest.fixture(scope="module")
def settings(config):
    return config().existence


def discs(means, normal=(0.0, 0.0, -1.0), std=0.05, features=(0.0, 0.0)) -> Gaussians:
    """Flat round Gaussians."""
    made = flat_gaussians(means, std, normal, 0.003)
    # Half a disc's covariance lies across it: std² I + 3² mm² in its plane.
    covs = np.asarray(made.covs) + 0.003**2 * (np.eye(3) - np.outer(normal, normal))
    return replace(made, covs=covs, features=np.broadcast_to(np.asarray(features, float), (covs.shape[0], 2)))


def map_of(*parts: Gaussians, existence=0.5, weight=1.0) -> GaussianMap:
    return fresh_map(join(*parts), weight, existence)


def filled(map: GaussianMap) -> GaussianMap:
    """With free rows after those of the map, as many as every program has."""
    rows, count = np.arange(NUM_ROWS), map.weight.shape[0]
    more = rows_of(map, np.minimum(rows, count - 1))
    return eqx.tree_at(lambda m: m.gaussians.valid, more, more.gaussians.valid & (rows < count))


def judged(map: GaussianMap, use, *look_and_settings, before=None):
    """The rows of the map after a look that fused something into some of them, and which it sees.

    The pose before is that of the look, or as given.
    """
    count = map.weight.shape[0]
    *given, settings = look_and_settings
    frame = Look(*given, given[1] if before is None else before)
    after, is_seen = judged_map(filled(map), np.resize(np.int32(use), NUM_ROWS), frame, settings)
    return rows_of(after, slice(count)), is_seen[:count]


def joined(map: GaussianMap, is_seen, T_world_camera, depth_noise, settings) -> GaussianMap:
    """After one look."""
    seen, origin = np.resize(is_seen, NUM_ROWS), np.asarray(T_world_camera.translation())
    after = joined_map(filled(map), seen & (np.arange(NUM_ROWS) < len(is_seen)), origin, depth_noise, settings)
    return rows_of(after, slice(len(is_seen)))


def merged(map: GaussianMap, origins, noise, settings) -> GaussianMap:
    origins = np.float32(np.resize(origins, (NUM_ROWS, 3)))
    return rows_of(merged_map(filled(map), origins, noise, settings), slice(map.weight.shape[0]))


def is_confirmed(map: GaussianMap) -> np.ndarray:
    return np.asarray(confirmed(map).valid)


def look(depth, valid=True) -> Observation:
    """What a camera at the origin sees of a depth image (h, w)."""
    depth = np.broadcast_to(np.asarray(depth, float), (CAMERA.height, CAMERA.width))
    x, y = (np.arange(CAMERA.width) - 31.5) / 40.0, (np.arange(CAMERA.height) - 23.5) / 44.0
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
    points, count = (rays * depth[..., None]).reshape(-1, 3), depth.size
    valid = np.broadcast_to(np.asarray(valid), depth.shape).reshape(-1)
    towards, grey = np.tile([0.0, 0, -1], (count, 1)), np.full((count, 3), 0.5)
    return Observation(*map(device, (points, grey, towards, np.zeros((count, 0)), np.ones(count), valid)))


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
        map, _ = judged(map, 1, look(noisy), HERE, CAMERA, NOISE, settings)
    wall, slab, pole = np.split(np.asarray(map.gaussians.valid), [len(WALL), len(WALL) + len(SLAB)])
    assert not slab.any() and wall.mean() >= 0.99 and pole.all()
    assert not map.gaussians.means[len(WALL)].any()  # the row is free


def looked_at(depths, settings, angle=0.06) -> GaussianMap:
    """The slab, seen often before, after looks at depths, to each of which the camera turns by an angle (rad); None is
    a look at what hides it."""
    map, before = map_of(discs(SLAB), existence=float(settings.max_log_odds)), pose((0.0, angle, 0.0))
    for depth in depths:
        map, _ = judged(map, 1, look(1.0 if depth is None else depth), HERE, CAMERA, NOISE, settings, before=before)
    return map


@pytest.mark.parametrize(
    ("depths", "stays"),
    [
        pytest.param([3.0, 3.0], True, id="too few looks"),
        pytest.param([3.0, 3.0, 3.0], False, id="it has gone"),
        pytest.param([3.0, None, 3.0, None, 3.0], False, id="hidden in between"),
        pytest.param([3.0, 3.0, 2.0, 3.0, 3.0], True, id="seen in between"),
        pytest.param([2.0 * 1.04**n for n in range(8)], True, id="depths drift"),
        pytest.param([2.15, 2.4, 3.0, 3.0, 3.0], True, id="space opens in steps"),
        pytest.param([2.15, 2.0, 3.0, 3.0, 3.0], False, id="seen again after a step, then gone"),
        pytest.param([3.0, 2.15, 3.0, 2.15], True, id="small steps do not count"),
        pytest.param([3.0, 2.15, 3.0, 2.15, 3.0], False, id="nor do they end a row"),
    ],
)
def test_what_was_seen_often_goes_after_a_few_looks_through_it_unless_depths_drift(depths, stays, settings):
    """At 2 m, space of 12 cm is free and of 24 cm clearly so."""
    valid = np.asarray(looked_at(depths, settings).gaussians.valid)
    assert valid.all() if stays else not valid.any()


def test_a_camera_that_hardly_moves_needs_more_looks_and_one_that_stands_is_no_second_view(settings):
    """A frame is as much of a view as the angle to the one before, of .05."""
    for angle, num, stays in ((0.02, 7, True), (0.02, 8, False), (0.0, 10, True), (0.5, 2, True)):
        map = looked_at([3.0] * num, settings, angle)
        assert np.asarray(map.gaussians.valid).all() == stays, (angle, num)


@pytest.mark.parametrize(("aside", "stays"), [(2, True), (8, False)])
def test_the_edge_of_a_surface_that_a_look_shows_somewhat_aside_stays(aside, stays, settings):
    """By 2 of 64 pixels; by 8 it is another surface, and what was before goes."""
    depth = np.full((CAMERA.height, CAMERA.width), 3.0)
    depth[:, 22 + aside : 43 + aside] = 2.0
    valid = np.asarray(looked_at([depth] * 4, settings).gaussians.valid)
    assert valid.all() == stays
    assert valid.sum() > 0.5 * len(SLAB)


def test_patience_is_a_number_of_looks_and_infinite_as_printed(settings):
    for patience, stays in ((5.0, True), (4.0, False), (np.inf, True)):
        settings = replace(settings, patience=device(patience))
        assert np.asarray(looked_at([3.0] * 4, settings).gaussians.valid).all() == stays


def test_a_fresh_wrong_gaussian_goes_sooner_and_one_that_explains_is_confirmed(settings):
    map = map_of(discs([(0, 0, 3.0), (0.2, 0, 2.7)]), existence=float(settings.birth))
    assert not is_confirmed(map).any()
    map, is_seen = judged(map, 1, look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(is_seen, [True, False])
    np.testing.assert_array_equal(is_confirmed(map), [True, False])
    np.testing.assert_allclose(map.existence, [settings.hit, -settings.miss])
    for _ in range(5):
        map, _ = judged(map, 1, look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(map.gaussians.valid, [True, False])
    for _ in range(9):
        map, _ = judged(map, 1, look(3.0), HERE, CAMERA, NOISE, settings)
    assert map.existence[0] == settings.max_log_odds


def test_what_is_on_the_surface_and_explains_nothing_goes_but_what_a_view_from_afar_cannot_resolve(settings):
    """All at one place, the first four tentative: of no use, and so small, of use, not in the submap; then confirmed
    ones of no use: as wide as a pixel (3 m / 40), and a little less."""
    birth, pixel = float(settings.birth), 3.0 / 40.0
    stds = 0.05, 0.1, 0.1, 0.1, 1.01 * pixel, 0.99 * pixel
    known = [birth] * 4 + [0.1] * 2
    map = map_of(*(discs((0, 0, 3.0), std=std) for std in stds), existence=known)
    use = np.array([-1, -1, 1, 0, -1, -1])
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
    after, is_seen = judged(map, use, look(depth), HERE, CAMERA, NOISE, settings)
    assert not is_seen.any()
    np.testing.assert_allclose(after.existence, [-1.0 + (settings.hit if use > 0 else 0.0)], atol=1e-6)


def test_at_an_edge_of_depth_both_surfaces_are_seen_though_a_pixel_shows_one(settings):
    """A pose that is wrong by a pixel shows the other; both explain nothing, which counts against what is seen."""
    depth = np.where(np.arange(CAMERA.width) < CAMERA.width // 2, 2.0, 4.0)
    map = map_of(discs([(0, 0, 2.0), (0, 0, 4.0)], std=0.2), existence=0.5)
    after, is_seen = judged(map, -1, look(depth), HERE, CAMERA, NOISE, settings)
    assert is_seen.all()
    np.testing.assert_allclose(after.existence, np.float32(0.5) - settings.miss, atol=1e-6)


def test_what_is_seen_through_is_not_confirmed_by_what_it_explains(settings):
    map = map_of(discs((0, 0, 2.7)))
    after, _ = judged(map, 1, look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_allclose(after.existence, np.asarray(map.existence) - settings.miss, atol=1e-6)


def test_usefulness_is_what_a_frame_fused_into_each_row_of_its_submap():
    map, rows = map_of(discs(WALL[:5])), np.array([3, 1, 5])  # the last is padding
    submap = replace(rows_of(map, np.minimum(rows, 4)), num_updates=np.int32([1 + 2, 1, 1 + 1]))
    np.testing.assert_array_equal(on_host(fusion_evidence)(map, submap, rows), [0, -1, 0, 1, 0])


EDGE = np.where(np.arange(CAMERA.width) < 32, 1.5, 3.0)
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
    after, is_seen = judged(map, -1, look(depth, valid), HERE, CAMERA, NOISE, settings)
    assert_same(after, rows_of(map, slice(None)))
    assert not is_seen.any()


@pytest.mark.parametrize(
    ("offset", "of_use", "of_none"), [(-0.25, -1, -1), (-0.15, 1, -1), (0.15, 1, -1), (0.25, 1, 0)]
)
def test_three_standard_deviations_decide(settings, offset, of_use, of_none):
    """Two percent of 3 m and 3 mm of the Gaussian: 3σ = 18 cm; a pixel and its neighbours differ by nothing."""
    map = map_of(discs((0, 0, 3.0 + offset)), existence=0.0)
    for use, change in ((1, of_use), (-1, of_none)):
        after, _ = judged(map, use, look(3.0), HERE, CAMERA, NOISE, settings)
        np.testing.assert_allclose(after.existence, {-1: -settings.miss, 0: 0.0, 1: settings.hit}[change])


@pytest.mark.parametrize("of_normal", [0.003, 0.1])
def test_what_is_thick_itself_is_on_the_surface_farther_from_it(settings, of_normal):
    """Three standard deviations of the look and of the Gaussian along its normal: 18 and 35 cm at 3 m."""
    gaussians = discs([(0, 0, 3.0 - offset) for offset in (0.15, 0.25, 0.4)])
    covs = np.asarray(gaussians.covs) + np.diag([0.0, 0.0, of_normal**2])
    after, is_seen = judged(map_of(replace(gaussians, covs=covs)), 1, look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_array_equal(is_seen, [True, of_normal > 0.01, False])
    np.testing.assert_array_equal(after.existence > 0.5, is_seen)


def test_evidence_beyond_its_limit_stays_until_a_look_says_something(settings):
    """Births may be above the limit."""
    beyond = float(settings.max_log_odds) + 3.0
    map = map_of(discs([(0, 0, 3.0), (0, 0, 4.0)]), existence=beyond)
    after, _ = judged(map, [1, 0], look(3.0), HERE, CAMERA, NOISE, settings)
    np.testing.assert_allclose(after.existence, [settings.max_log_odds, beyond])


def test_depth_range_is_of_the_pixel_and_its_neighbours():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0)
    depth[10, 20], depth[30, 40] = 1.0, 5.0
    valid = np.ones_like(depth, bool)
    valid[30, 41] = False
    near, far = np.asarray(ranges(look(depth, valid), HERE, CAMERA)).reshape(2, *depth.shape)
    assert near[9, 19] == 1 and near[11, 21] == 1 and near[12, 20] == 2 and far[9, 19] == 2
    assert far[31, 41] == 5 and far[30, 39] == 5 and near[30, 40] == 2
    assert np.isnan(near[30, 41]) and np.isnan(far[30, 41])


def test_two_sheets_of_a_wall_become_one_and_it_is_no_thicker(settings):
    """5 cm apart at 3 m, where a look has 6 cm of noise: the mean by weight, and half as many Gaussians."""
    front, back = discs([(x, y, 2.95) for x, y, _ in WALL[::4]]), discs([(x, y, 3.0) for x, y, _ in WALL[::4]])
    count = front.valid.shape[0]
    map = map_of(front, back, weight=np.repeat([1.0, 3.0], count), existence=np.repeat([0.5, 2.0], count))
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    kept = after.gaussians.valid
    assert not kept[:count].any() and kept[count:].all()  # the heavier row stays
    means, covs = after.gaussians.means[kept], after.gaussians.covs[kept]
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
    row = int(np.argmax(after.gaussians.valid))
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
    after = joined(map, map.gaussians.valid & np.array([True, seen]), HERE, device(noise), settings)
    assert_same(after, rows_of(map, slice(None)))


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
    map = map_of(discs(positions), weight=weights)
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    assert (after.gaussians.valid.sum() == 1) == is_one
    if is_one:
        np.testing.assert_allclose(after.gaussians.covs[0, 2, 2], 0.003**2, rtol=1e-3)
    else:
        assert_same(after, rows_of(map, slice(None)))


def test_both_sides_of_a_panel_are_two_surfaces_and_a_missing_feature_says_nothing(settings):
    both = [discs((0, 0, 2.0)), discs((0, 0, 2.02), normal=(0.0, 0, 1.0))]
    map = map_of(*both)
    assert_same(joined(map, map.gaussians.valid, HERE, NOISE, settings), rows_of(map, slice(None)))
    unlabelled = map_of(discs([(0, 0, 2.0), (0, 0, 2.02)], features=[(1.0, 0), (0, 0.0)]))
    assert joined(unlabelled, unlabelled.gaussians.valid, HERE, NOISE, settings).gaussians.valid.sum() == 1


@pytest.mark.parametrize(("reading", "expected"), [(0.0, [1.0, 0.0]), (1.0, [4.0, 1.0])])
def test_the_evidence_of_both_layers_is_that_of_the_one_as_far_as_evidence_accumulates(settings, reading, expected):
    map = map_of(discs([(0, 0, 2.0), (0, 0, 2.02)], features=[(1.0, 0), (3.0, 1.0)]))
    after = joined(map, map.gaussians.valid, HERE, NOISE, at(settings, "feature", reading))
    np.testing.assert_array_equal(after.gaussians.features[after.gaussians.valid], [expected])


def test_of_three_layers_the_two_that_chose_each_other_become_one(settings):
    map = map_of(discs([(0, 0, 2.0), (0, 0, 2.01), (0, 0, 2.035)]))
    after = joined(map, map.gaussians.valid, HERE, NOISE, settings)
    np.testing.assert_array_equal(after.gaussians.valid, [True, False, True])  # of equal weights, the first row
    np.testing.assert_allclose(after.gaussians.means[::2, 2], [2.005, 2.035], atol=1e-6)


def test_nothing_stands_behind_what_is_itself_as_thick(settings):
    """Layers of 20, 3 and 20 mm at 3, 3.038 and 2.94 m: of the first and the second neither is a sheet behind."""
    layers = discs([(0, 0, 3.0), (0, 0, 3.038), (0, 0, 2.94)])
    covs = np.array(layers.covs)
    covs[:, 2, 2] = np.square([0.02, 0.003, 0.02])
    map = map_of(replace(layers, covs=covs))
    after = joined(map, map.gaussians.valid, HERE, device(0.01), settings)
    np.testing.assert_array_equal(after.gaussians.valid, [True, True, False])
    np.testing.assert_allclose(after.gaussians.means[:2, 2], [2.97, 3.038], atol=1e-6)


def test_layers_of_visits_that_moved_become_one_though_nobody_looks(settings):
    """Two sheets of a wall 4 cm apart and a third one 4 cm behind, seen from 3 m; one seen from beside stays."""
    wall = WALL[::4]
    sheets = [[(x, y, 3.0 + 0.04 * k) for x, y, _ in wall] for k in range(3)]
    map = map_of(*(discs(sheet) for sheet in sheets), discs([(5.0, 0, 3.0), (5.0, 0, 3.04)]))
    count, origins = len(wall), np.zeros((3 * len(wall) + 2, 3))
    origins[-2:] = 8.0, 0, 3.0
    after = merged(map, origins, NOISE, settings)
    assert after.gaussians.valid[: 3 * count].sum() == count and after.gaussians.valid[-2:].all()
    kept = after.gaussians.valid.copy()
    kept[-2:] = False
    np.testing.assert_allclose(after.gaussians.means[kept, 2], 3.04, atol=0.021)
    np.testing.assert_allclose(after.gaussians.covs[kept, 2, 2], 0.003**2, rtol=1e-3)  # no thicker
    np.testing.assert_allclose(after.weight[kept], 3.0)
    assert_same(merged(after, origins, NOISE, settings), after)


def test_as_printed_nothing_changes_by_a_bit(config):
    printed = config("slam/existence=paper").existence
    map = map_of(discs(WALL), discs(SLAB), existence=float(printed.birth))
    for _ in range(5):
        after, is_seen = judged(map, -1, look(3.0), HERE, CAMERA, NOISE, printed)
    assert_same(after, rows_of(map, slice(None)))
    assert is_seen[: len(WALL)].any()  # it looks, but draws no conclusion
    assert_same(joined(map, is_seen, HERE, NOISE, printed), after)
    assert_same(merged(map, np.zeros((len(is_seen), 3)), NOISE, printed), after)
    assert is_confirmed(map).all()


def test_a_frame_that_is_not_tracked_says_nothing(settings):
    map = map_of(discs(WALL), discs(SLAB), existence=-1.9)
    after, is_seen = judged(map, -1, look(3.0, valid=False), HERE, CAMERA, device(0.0), settings)
    assert_same(after, rows_of(map, slice(None)))
    assert not is_seen.any()


def test_what_a_frame_has_said_where_something_moved_is_taken_back(settings):
    """A block at 2 m before a wall at 3 m has moved in the left half of a frame: what else it has seen stays."""
    rows, columns = np.indices((48, 64))
    depth = np.where(abs(columns - 31.5) < 20, 2.0, 3.0)
    depths = ranges(look(depth), HERE, CAMERA)
    moves = (columns < 31).reshape(-1)
    places = {  # mean, normal: what is taken back
        "moved": ((-0.5, 0.0, 2.0), (0, 0, -1), True),
        "within the noise": ((-0.5, 0.2, 2.05), (0, 0, -1), True),
        "stands": ((0.5, 0.0, 2.0), (0, 0, -1), False),
        "before it": ((-0.5, 0.0, 1.5), (0, 0, -1), False),
        "hidden by it": ((-0.5, 0.0, 3.0), (0, 0, -1), False),
        "too grazing to be seen": ((-0.5, 0.1, 2.0), (0, 1, 0), False),
        "behind the camera": ((-0.5, 0.0, -2.0), (0, 0, -1), False),
        "in no pixel with a depth": ((-1.3, -0.9, 2.9), (0, 0, -1), False),
    }
    depths = np.where((columns < 20) & (rows < 15), 0.0, depths.reshape(2, 48, 64)).reshape(2, -1)
    parts = [discs([mean], normal) for mean, normal, _ in places.values()]
    seen = Seen(depths, moves, HERE, NOISE, np.int32(3))
    for existence in (2.0, settings.refuted + 0.1):
        before = filled(map_of(*parts, existence=existence))
        after = rows_of(corrected_map(before, jax.tree.map(device, seen), CAMERA, settings), slice(len(places)))
        is_back = np.array([back for *_, back in places.values()])
        lost = np.where(is_back, settings.hit + settings.miss, 0.0)
        gone = is_back & (existence - lost < settings.refuted)
        np.testing.assert_allclose(after.existence[~gone], (existence - lost)[~gone], rtol=1e-6)
        np.testing.assert_array_equal(after.gaussians.valid, ~gone)
