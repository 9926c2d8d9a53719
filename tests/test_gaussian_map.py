"""The running average against the recursion's literal values, submaps against NumPy, rows that are kept or counted."""

import equinox as eqx
import jax
import numpy as np
import pytest
import reference
import scene as sc
from hand_run import random_similarity

from emgs_jax.gaussian_map import (
    GaussianMap,
    empty_map,
    grow,
    insert,
    select_submap,
    transformed,
    update_average,
    write_back,
)
from emgs_jax.gaussians import empty_gaussians

update, select, inserted_into, written = (sc.on_host(f) for f in (update_average, select_submap, insert, write_back))


def map_of(count: int, capacity: int, seed: int = 0) -> GaussianMap:
    """So many Gaussians, and free rows."""
    map, free = sc.fresh_map(sc.random_gaussians(count, seed)), jax.device_get(empty_map(capacity - count, 0))
    return jax.tree.map(lambda *rows: sc.device(np.concatenate(rows)), map, free)


MAP = map_of(200, 256)


@pytest.fixture(scope="module")
def average(config):
    return {kind: config(f"slam.em.average.gain={kind}").em.average for kind in ("ema_printed", "count")}


def averaged(values, evidence, config):
    """Mean's x of one Gaussian after each value, its gains, and its map."""
    map, means, gains = map_of(1, 1), [], []
    map = eqx.tree_at(lambda m: m.gaussians.means, map, np.zeros((1, 3), np.float32))
    for value, delta in zip(values, evidence, strict=True):
        new = sc.replace(map.gaussians, means=np.full((1, 3), value))
        map, gain = update(map, new, np.float32([delta]), config)
        means.append(float(map.gaussians.means[0, 0]))
        gains.append(float(gain[0]))
    return means, gains, map


def test_the_printed_gain_follows_its_recursion(average):
    _, gains, map = averaged([1.0] * 4, [0.5] * 4, average["ema_printed"])
    # α = .5 / (α + .5) from α_0 = 1; float32 roundings
    np.testing.assert_allclose(gains, [1 / 3, 3 / 5, 5 / 11, 11 / 21], rtol=1e-6)
    np.testing.assert_allclose(map.weight, gains[-1])
    assert map.num_updates == 5


@pytest.mark.parametrize("kind", ["ema_printed", "count"])
def test_uneven_evidence_gives_the_reference_average(average, kind):
    values, evidence = [3.0, -1.0, 4.0, 1.0], [0.2, 1.0, 0.05, 0.7]
    means, _, _ = averaged(values, evidence, average[kind])
    np.testing.assert_allclose(means, reference.running_average(values, 0.0, evidence, kind), atol=1e-6)


def test_forgetting_shrinks_the_kept_weight_before_each_update(average):
    _, gains, map = averaged([1.0] * 2, [1.0] * 2, sc.at(average["count"], "forgetting", 0.5))
    np.testing.assert_allclose(gains, [1 / 1.5, 1 / 1.75], rtol=1e-6)  # W: 1, .5 + 1, .75 + 1
    np.testing.assert_allclose(map.weight, 1.75, rtol=1e-6)


def test_certainty_ends_at_the_largest_weight(average):
    """A camera that stands still for long must not make a map that no later view can move."""
    _, gains, map = averaged([1.0] * 5, [1.0] * 5, sc.at(average["count"], "max_weight", 3.0))
    np.testing.assert_allclose(gains, [1 / 2, 1 / 3, 1 / 4, 1 / 4, 1 / 4], rtol=1e-6)
    np.testing.assert_allclose(map.weight, 4.0)


@pytest.mark.parametrize("kind", ["ema_printed", "count"])
def test_a_gaussian_without_evidence_or_that_is_invalid_stays_bit_for_bit(average, kind):
    map = map_of(6, 8)
    evidence = np.float32([0.0, 0.5, 0.0, 1.0, 0.0, 0.2, 0.7, 0.7])  # the last two rows are free
    wild = sc.poisoned(sc.random_gaussians(8, 5), evidence > 0, np.nan)
    updated, gain = update(map, wild, evidence, average[kind])
    still = np.array([0, 2, 4, 6, 7])
    sc.assert_same(sc.rows_of(updated, still), sc.rows_of(map, still))
    np.testing.assert_array_equal(np.asarray(gain)[still], 0)
    np.testing.assert_array_equal(updated.num_updates, [1, 2, 1, 2, 1, 2, 0, 0])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(updated))


def in_box(map, clouds, config):
    """Rows of the valid Gaussians whose voxel meets the voxels of the clouds' box."""
    points = np.concatenate([np.asarray(c.points)[np.asarray(c.valid)] for c in clouds])
    size, margin = float(config.voxel_size), float(config.margin)
    low, high = (np.floor(x / size) for x in (points.min(0) - margin, points.max(0) + margin))
    voxels = np.floor(np.asarray(map.gaussians.means) / size)
    return np.flatnonzero(((voxels >= low) & (voxels <= high)).all(1) & np.asarray(map.gaussians.valid))


def box_cloud(low, high):
    return sc.replace(sc.random_observation(40), points=np.linspace(low, high, 40))


CLOUDS = box_cloud([-0.5, -0.4, 1.2], [0.0, 0.3, 1.9]), box_cloud([-0.2, 0.0, 1.5], [0.33, 0.41, 2.5])


def test_a_submap_holds_the_gaussians_in_the_box_of_the_clouds(config):
    config = config("slam.submap.voxel_size=0.13", "slam.submap.margin=0.07").submap
    is_left = np.asarray(MAP.gaussians.valid) & (np.arange(256) % 7 > 0)  # of the others some are in the box
    map = eqx.tree_at(lambda m: m.gaussians.valid, MAP, sc.device(is_left))
    submap, rows, overflow = select(map, CLOUDS, config)
    expected = in_box(map, CLOUDS, config)
    assert 20 < len(expected) < 100 and overflow == 0
    exists = submap.gaussians.valid
    np.testing.assert_array_equal(rows[exists], expected)
    np.testing.assert_array_equal(rows[~exists], 256)
    sc.assert_same(sc.rows_of(submap, exists), sc.rows_of(map, expected))


def test_invalid_points_do_not_widen_the_box(config):
    wild = sc.replace(CLOUDS[1], points=np.full((40, 3), 1e6), valid=np.zeros(40, bool))
    # Rows past the end are no rows of the map, so only the valid part is compared.
    one, other = (select(MAP, clouds, config().submap) for clouds in ((CLOUDS[0], wild), (CLOUDS[0], CLOUDS[0])))
    np.testing.assert_array_equal(one[1], other[1])


def test_clouds_without_a_valid_point_select_nothing(config):
    empty = sc.replace(CLOUDS[0], valid=np.zeros(40, bool))
    submap, rows, overflow = select(MAP, (empty, empty), config().submap)
    assert not submap.gaussians.valid.any() and overflow == 0
    np.testing.assert_array_equal(rows, 256)


def test_a_submap_that_is_too_small_by_one_counts_one(config):
    map = MAP
    count = len(in_box(map, CLOUDS, config().submap))
    for capacity, expected in ((count, 0), (count - 1, 1)):
        submap, _, overflow = select(map, CLOUDS, config(f"slam.submap.submap_capacity={capacity}").submap)
        assert overflow == expected and submap.gaussians.valid.all()


@pytest.mark.parametrize("capacity", [192, 10])
def test_writing_an_unchanged_submap_back_changes_no_bit(config, capacity):
    map = MAP
    submap, rows, _ = select(map, CLOUDS, config(f"slam.submap.submap_capacity={capacity}").submap)
    sc.assert_same(written(map, submap, rows), map)


def test_a_changed_submap_changes_its_rows_only(config):
    map = MAP
    submap, rows, _ = select(map, CLOUDS, config().submap)
    expected = np.array(map.weight)
    expected[in_box(map, CLOUDS, config().submap)] += 5
    changed = sc.replace(submap, weight=submap.weight + np.float32(5))
    np.testing.assert_array_equal(written(map, changed, rows).weight, expected)


def with_holes(holes):
    """Ten Gaussians but for those rows."""
    map = sc.fresh_map(sc.random_gaussians(10))
    return eqx.tree_at(lambda m: m.gaussians.valid, map, sc.device(~np.isin(np.arange(10), holes)))


def inserted_rows(map, fresh, **more):
    """The map with new Gaussians, how many it has now, and how many found no row."""
    return inserted_into(map, sc.fresh_map(fresh, **more))


def test_fresh_gaussians_fill_the_free_rows_in_order():
    map, fresh = with_holes([2, 3, 7, 9]), sc.random_gaussians(5, 9)
    fresh = sc.replace(fresh, valid=np.array([False, True, True, False, True]))
    inserted, count, overflow = inserted_rows(map, fresh, weight=np.arange(5.0), existence=0.25, birth=6)
    assert (count, overflow) == (3, 0)
    for row, source in ((2, 1), (3, 2), (7, 4)):
        np.testing.assert_array_equal(inserted.gaussians.means[row], np.asarray(fresh.means)[source])
        assert inserted.weight[row] == source and inserted.num_updates[row] == 1
        assert inserted.existence[row] == 0.25 and inserted.birth[row] == 6
    np.testing.assert_array_equal(inserted.gaussians.valid, [True] * 9 + [False])
    others = np.array([0, 1, 4, 5, 6, 8])
    sc.assert_same(sc.rows_of(inserted, others), sc.rows_of(map, others))


@pytest.mark.parametrize(
    ("holes", "num_new", "overflow"),
    [([2], 5, 4), ([], 5, 5), ([1, 4], 5, 3), ([0, 1, 4, 6, 9], 5, 0), (range(10), 5, 0), (range(10), 12, 2)],
    ids=str,
)
def test_what_finds_no_free_row_is_counted_and_the_rest_is_kept(holes, num_new, overflow):
    map = with_holes([*holes])
    inserted, count, lost = inserted_rows(map, sc.random_gaussians(num_new, 9))
    assert (count, lost) == (num_new - overflow, overflow)
    assert inserted.gaussians.valid.sum() == 10 - len(holes) + min(num_new, len(holes))
    kept = np.setdiff1d(np.arange(10), holes)
    sc.assert_same(sc.rows_of(inserted, kept), sc.rows_of(map, kept))


def test_inserting_nothing_changes_no_bit():
    map = with_holes([1, 3])
    inserted, count, overflow = inserted_rows(map, jax.device_get(empty_gaussians(5, 0)), weight=7.0)
    sc.assert_same(inserted, map)
    assert (count, overflow) == (0, 0)


def test_growing_keeps_every_row_and_adds_free_neutral_ones():
    map = map_of(5, 8)
    grown = grow(map, 16)
    sc.assert_same(sc.rows_of(grown, slice(8)), map)
    sc.assert_same(sc.rows_of(grown, slice(8, None)), empty_map(8, 0))
    assert not (grown.weight[8:].any() or grown.existence[8:].any() or grown.gaussians.valid[8:].any())


def test_a_similarity_keeps_what_a_map_says_of_every_point():
    """Mahalanobis distances and sides of surfaces are the same; free rows stay neutral, and what has no length too."""
    moved, rng = random_similarity(np.random.default_rng(1), 1.7), np.random.default_rng(2)
    new, points = transformed(MAP, **vars(moved)), rng.normal(size=(200, 3))

    def seen(map: GaussianMap, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = jax.tree.map(lambda leaf: np.asarray(leaf[:200], np.float64), map.gaussians)
        offsets = at - rows.means
        sides = np.einsum("ni,ni->n", offsets, rows.normals)
        return np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(rows.covs), offsets), sides

    (distance, side), (new_distance, new_side) = seen(MAP, points), seen(new, moved.apply(points))
    np.testing.assert_allclose(new_distance, distance, rtol=1e-4)  # of inverses in float32
    np.testing.assert_allclose(new_side, 1.7 * side, atol=1e-5)
    sc.assert_same(sc.rows_of(new, np.arange(256) >= 200), sc.rows_of(MAP, np.arange(256) >= 200))
    for name in ("weight", "num_updates", "existence", "birth"):
        np.testing.assert_array_equal(getattr(new, name), getattr(MAP, name))


def test_a_field_of_which_nobody_says_how_it_moves_stops_every_similarity():
    class Tagged(GaussianMap):
        tag: jax.Array

    with pytest.raises(KeyError, match="tag"):
        transformed(Tagged(**vars(MAP), tag=MAP.weight), **vars(random_similarity(np.random.default_rng(0), 1.0)))
