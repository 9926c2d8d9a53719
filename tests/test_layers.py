"""Two maps of one wall become one layer half way between them, two sheets of a wall one sheet; all else stays."""

import equinox as eqx
import numpy as np
import pytest
from scene import device, flat_gaussians, fresh_map, join, on_host

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.layers import fuse_sheets, one_layer

made_one, of_one_sheet = on_host(one_layer), on_host(fuse_sheets)
GRID = np.arange(-1.0, 1.01, 0.1)
FIRST = np.array([(x, y, 3.0) for x in GRID for y in GRID])
GAP, BEYOND = 0.04, 0.6  # m; the other wall is so far behind the first, and goes on so far beside it
OTHER = FIRST + [BEYOND, 0.03, GAP]
NORMAL = (0.0, 0.0, -1.0)


def walls(*parts, normal=NORMAL) -> tuple[GaussianMap, np.ndarray]:
    """Walls of flat Gaussians, and which rows are not the first's."""
    gaussians = join(*(flat_gaussians(part, 0.05, normal, 0.003) for part in parts))
    is_other = np.repeat(np.arange(len(parts)) > 0, [len(part) for part in parts])
    features = np.stack([~is_other, 0.5 * is_other + 0.5], axis=1).astype(float)
    return fresh_map(eqx.tree_at(lambda g: g.features, gaussians, features), 2.0, 0.5), is_other


def after(config, map: GaussianMap, is_other, noise: float = 0.02) -> GaussianMap:
    return made_one(map, is_other, np.zeros(map.gaussians.means.shape, np.float32), device(noise), config().existence)


def test_both_walls_move_half_way_and_the_other_is_fused_into_the_first(config):
    map, is_other = walls(FIRST, OTHER)
    one = after(config, map, is_other)
    old, new, valid = np.asarray(map.gaussians.means), np.asarray(one.gaussians.means), np.asarray(one.gaussians.valid)
    is_seen_twice = np.where(is_other, old[:, 0] <= 0.95, old[:, 0] >= -0.35)
    np.testing.assert_allclose(new[valid & is_seen_twice, 2], 3.0 + GAP / 2, atol=2e-3)
    assert valid[~is_other].all() and not valid[is_other & is_seen_twice].any(), "each is one, in the first's rows"
    taken = valid & ~is_other & (np.asarray(one.weight) > 2.0)
    assert one.weight[valid].sum() == map.weight.sum() and np.asarray(one.num_updates)[valid].sum() == len(is_other)
    np.testing.assert_allclose(np.asarray(one.gaussians.normals)[taken], np.tile(NORMAL, (taken.sum(), 1)), atol=1e-6)
    across = np.asarray(one.gaussians.covs)[taken][:, 2, 2]
    before = np.asarray(map.gaussians.covs)[0, 2, 2]
    np.testing.assert_allclose(across, before, rtol=1e-3, err_msg="no thicker by two layers")


def test_what_is_fused_into_a_layer_makes_it_as_sure_as_the_surer_of_both_and_no_thicker(config):
    """The other wall is rough by 3 mm: what it is moved by is a mean over neighbours, so that half of that stays."""
    rough = 0.003 * np.where(np.arange(len(FIRST)) % 2, 1.0, -1.0)[:, None]
    map, is_other = walls(FIRST, FIRST + [0, 0, GAP] + rough * [0, 0, 1])
    existence = device(np.random.default_rng(0).uniform(0.5, 4.0, (2, len(FIRST))))
    one = after(config, eqx.tree_at(lambda m: m.existence, map, existence.ravel()), is_other)
    np.testing.assert_array_equal(one.gaussians.valid, ~is_other)
    rows = np.flatnonzero(np.abs(FIRST[:, :2]).max(axis=1) < 0.65)
    apart = np.asarray(one.gaussians.means)[rows, 2] - 3.0 - GAP / 2
    assert (np.abs(apart) > 1e-3).all() and (apart > 0).any() and (apart < 0).any()
    across = np.asarray(one.gaussians.covs)[rows][:, 2, 2]
    np.testing.assert_allclose(across, np.asarray(map.gaussians.covs)[0, 2, 2], rtol=1e-3)
    np.testing.assert_array_equal(np.asarray(one.existence)[~is_other], np.asarray(existence).max(axis=0))


def test_what_only_one_of_both_shows_stays_and_no_step_is_between(config):
    map, is_other = walls(FIRST, OTHER)
    one = after(config, map, is_other)
    old, new, valid = np.asarray(map.gaussians.means), np.asarray(one.gaussians.means), np.asarray(one.gaussians.valid)
    alone = valid & np.where(is_other, old[:, 0] > 1.35, old[:, 0] < -0.75)
    assert alone[is_other].any() and alone[~is_other].any()
    np.testing.assert_array_equal(new[alone], old[alone])
    between = valid & ~is_other & (old[:, 0] < -0.4)
    steps = new[between, 2] - 3.0
    assert (steps >= 0).all() and (steps < GAP / 2).any() and (steps > GAP / 4).any()


def test_the_walls_of_a_corner_do_not_move_each_other(config):
    """Both maps show the side wall at one place, and the wall beside it 4 cm apart."""
    x = np.minimum(FIRST[:, 0], 0.55)
    corner = np.stack([x, FIRST[:, 1], 3.0 - (FIRST[:, 0] - x)], axis=1)
    is_side = corner[:, 0] == 0.55
    parts = [
        flat_gaussians(points, 0.05, normal, 0.003, features=(1.0, 0.0))
        for gap in (0.0, GAP)
        for points, normal in ((corner[~is_side] + [0, 0, gap], NORMAL), (corner[is_side], (-1.0, 0.0, 0.0)))
    ]
    one = after(config, fresh_map(join(*parts), 2.0, 0.5), np.repeat([False, True], len(FIRST)))
    expected = np.concatenate([corner[~is_side] + [0, 0, GAP / 2], corner[is_side]])
    np.testing.assert_array_equal(one.gaussians.valid, np.repeat([True, False], len(FIRST)))
    np.testing.assert_allclose(np.asarray(one.gaussians.means)[: len(FIRST)], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("parts", "change", "words"),
    [
        ((FIRST, OTHER + [0, 0, 0.5]), {}, ()),  # another wall, eight standard deviations behind
        ((FIRST, OTHER), {"normal": [NORMAL, (0.0, 0.0, 1.0)]}, ()),  # the other side of it
        ((FIRST, OTHER), {}, ("slam/existence=paper",)),
    ],
)
def test_what_is_no_second_layer_stays(config, parts, change, words):
    map, is_other = walls(*parts)
    if "normal" in change:
        normals = np.float32(change["normal"])[is_other.astype(int)]
        map = eqx.tree_at(lambda m: m.gaussians.normals, map, normals)
    one = made_one(
        map, is_other, np.zeros(map.gaussians.means.shape, np.float32), device(0.02), config(*words).existence
    )
    np.testing.assert_array_equal(one.gaussians.means, map.gaussians.means)
    assert np.asarray(one.gaussians.valid).all()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_maps_of_fewer_gaussians_than_a_mean_is_over_become_one_too(config, count):
    map, is_other = walls(FIRST[:count], FIRST[:count] + [0, 0, GAP])
    one = after(config, map, is_other)
    np.testing.assert_array_equal(one.gaussians.valid, ~is_other)
    np.testing.assert_allclose(np.asarray(one.gaussians.means)[:count, 2], 3.0 + GAP / 2, atol=1e-6)


FRONT = np.zeros(3)  # the camera that saw the nearer wall at z = 3
DESK, BOOK = FIRST + [0, 0, GAP], FIRST[np.abs(FIRST[:, :2]).max(axis=1) < 0.45]


def sheets(config, parts, weights, cameras=(FRONT, FRONT), noise=0.02, words=(), normal=NORMAL):
    """Walls with the weight of each, seen by the camera of each, before and after `fuse_sheets`."""
    map, is_other = walls(*parts, normal=normal)
    map = eqx.tree_at(lambda m: m.weight, map, device(np.where(is_other, weights[1], weights[0]).astype(float)))
    origins = device(np.where(is_other[:, None], cameras[1], cameras[0]))
    return map, of_one_sheet(map, origins, device(noise), config(*words).existence), is_other


@pytest.mark.parametrize("weights", [(9.0, 1.0), (1.0, 9.0)])
def test_two_sheets_of_a_wall_become_that_of_more_frames_moved_by_the_share_of_the_other(config, weights):
    map, one, is_other = sheets(config, (FIRST, DESK), weights)
    is_light = is_other == (weights[0] > weights[1])
    np.testing.assert_array_equal(one.gaussians.valid, ~is_light)
    z = np.asarray(one.gaussians.means)[~is_light, 2]
    mean = np.average([3.0, 3.0 + GAP], weights=weights)
    np.testing.assert_allclose(np.median(z), mean, atol=2e-3)
    np.testing.assert_allclose(one.weight[~is_light].sum(), map.weight.sum(), rtol=1e-6)
    np.testing.assert_allclose(one.gaussians.covs[~is_light][:, 2, 2], map.gaussians.covs[0, 2, 2], rtol=1e-3)


def test_a_book_and_the_desk_that_no_frame_saw_through_it_stay(config):
    """Seen from above at a slant, where the desk's Gaussians end at the shadow of the book."""
    above = np.array([-2.0, 0.0, 0.0])
    rays = DESK - above
    shadow = above + rays * (3.0 / DESK[:, 2:])
    beside = DESK[np.abs(shadow[:, :2]).max(axis=1) > 0.5]
    map, one, _ = sheets(config, (BOOK, beside), (9.0, 1.0), (above, above))
    assert np.asarray(one.gaussians.valid).all()
    np.testing.assert_array_equal(one.gaussians.means, map.gaussians.means)


def test_a_desk_that_was_seen_before_the_book_lay_on_it_is_taken_for_a_sheet_of_the_book(config):
    """What distinguishes them from sheets is that no frame sees one through the other; here one did."""
    _, one, is_other = sheets(config, (BOOK, DESK), (9.0, 1.0))
    under = is_other & (np.abs(np.concatenate([BOOK, DESK])[:, :2]).max(axis=1) < 0.35)
    valid = np.asarray(one.gaussians.valid)
    assert valid[~is_other].all() and not valid[under].any()


@pytest.mark.parametrize(
    ("parts", "cameras", "noise", "words"),
    [
        ((FIRST, DESK), (FRONT, FRONT), 0.002, ()),  # frames are sure to .6 cm: 4 cm are another wall
        ((FIRST, DESK), (FRONT, np.array([0, 0, 3.0 + GAP / 2])), 0.02, ()),  # from between them
        ((FIRST, FIRST + [0, 0, 0.005]), (FRONT, FRONT), 0.02, ()),  # one thick sheet
        ((FIRST, DESK), (FRONT, FRONT), 0.02, ("slam/existence=paper",)),
    ],
)
def test_what_is_no_second_sheet_stays(config, parts, cameras, noise, words):
    map, one, _ = sheets(config, parts, (9.0, 1.0), cameras, noise, words)
    assert np.asarray(one.gaussians.valid).all()
    np.testing.assert_array_equal(one.gaussians.means, map.gaussians.means)


def test_the_other_side_and_another_thing_are_no_second_sheet(config):
    for change in ("normals", "features"):
        map, is_other = walls(FIRST, DESK)
        values = np.array({"normals": [NORMAL, (0.0, 0.0, 1.0)], "features": [(1.0, 0.0), (-1.0, 0.2)]}[change])
        map = eqx.tree_at(lambda m: getattr(m.gaussians, change), map, device(values[is_other.astype(int)]))  # noqa: B023
        one = of_one_sheet(map, device(np.zeros((len(is_other), 3))), device(0.02), config().existence)
        assert np.asarray(one.gaussians.valid).all(), change
