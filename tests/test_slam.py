"""Whole steps and runs on the box room: exact poses, nothing fused when not tracked, growth that changes nothing, and a
map of noisy predictions that is better than they are."""

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pytest
import scene as sc
from scene import FULL, ROOM, WHOLE, exact, noisy_prediction

from emgs_jax import slam
from emgs_jax.localization import COARSE
from emgs_jax.mapping.capacity import advance, grow_capacities, start
from emgs_jax.mapping.convert import opening
from emgs_jax.observation import Prediction
from emgs_jax.slam import Overflow, StepInfo, init_state, step

FRAME = 3
pytestmark = pytest.mark.xdist_group("small")
# An exact chain, lenient checks: the room is coarse at this resolution.
LENIENT = {"localization.max_residual": 1.0, "localization.max_pose_std": np.inf}


def lenient(*overrides: str, **values):
    chosen = sc.slam_config(*WHOLE, "slam.localization.coarse=same_image", "slam.em.average.gain=count", *overrides)
    return sc.changed(chosen, **LENIENT, **values)


@pytest.fixture(scope="module")
def window(camera):
    poses = [sc.path_pose(i) for i in range(FRAME)]
    return sc.first_window(sc.stack([sc.observe_room(T, camera, num_features=2) for T in poses]), sc.stack_poses(poses))


@pytest.fixture(scope="module")
def settings():
    return lenient()


@pytest.fixture(scope="module")
def state(window, settings):
    return init_state(window.views, window.T_world_views, FULL, settings)[0]


@pytest.fixture(scope="module")
def stepped(state, settings):
    return step(state, exact(FRAME), FULL, settings)


def test_the_first_state_holds_the_last_view_as_it_is_in_the_world(state, window, camera):
    expected = sc.moved_points(sc.path_pose(FRAME - 1), sc.observe_room(sc.path_pose(FRAME - 1), camera))
    np.testing.assert_allclose(state.previous.points, expected.points, atol=1e-6)  # roundings
    assert max(sc.pose_error(state.T_world_previous, sc.path_pose(FRAME - 1))) < 1e-6
    valid = np.asarray(state.map.gaussians.valid)
    assert 0.95 * 96 < valid.sum() <= 96 == 3 * 768 // (8 * 3)  # some are of scattered points
    weights = np.asarray(state.map.weight)[valid]
    np.testing.assert_allclose(weights.sum(), 3 * 768 / 8, rtol=0.05)  # of λ points
    assert state.time == FRAME and (np.asarray(state.map.birth)[valid] == FRAME - 1).all()


def test_an_exact_prediction_is_tracked_and_its_points_are_fused_or_become_gaussians(state, stepped):
    new, info = jax.device_get(stepped)
    assert info.localization.is_tracked
    # Pixels are 10 cm apart here: a coarse map pulls by a small part of that (R9); the prior holds against it.
    distance, angle = sc.pose_error(info.T_world_camera, sc.path_pose(FRAME))
    assert distance < 0.02 and angle < 0.01
    assert info.em.num_points == 768 and info.em.num_fused > 0.5 * 768
    assert info.num_gaussians == new.map.gaussians.valid.sum()
    assert info.num_gaussians == state.map.gaussians.valid.sum() + info.refinement.num_fresh
    sc.assert_same(new.T_world_previous, info.T_world_camera)
    assert int(info.overflow.map) == int(info.overflow.submap) == 0
    assert max(sc.pose_error(info.T_world_newest, sc.path_pose(FRAME + 1))) < 5e-3  # the chain alone, which is exact


def test_the_frame_is_kept_as_it_was_aligned_for_the_next_step(stepped):
    new, info = stepped
    expected = sc.moved_points(info.T_world_camera, exact(FRAME).current, info.localization.scale)
    np.testing.assert_allclose(new.previous.points, expected.points, atol=1e-5)  # roundings, here and below
    np.testing.assert_allclose(new.previous.normals, expected.normals, atol=1e-5)


def doubled(map, distance):
    """The map with a second layer before it, in free rows."""
    held, rows = np.flatnonzero(map.gaussians.valid), np.arange(ROOM)
    beside = np.arange(len(held)) + len(held)
    rows[beside] = held
    both = jax.tree.map(sc.device, sc.rows_of(map, rows))
    means = np.array(both.gaussians.means)
    means[beside] += distance * np.asarray(map.gaussians.normals)[held]
    return eqx.tree_at(lambda m: m.gaussians.means, both, sc.device(means))


def test_two_layers_that_a_look_cannot_tell_apart_become_one(state, settings):
    held = np.flatnonzero(state.map.gaussians.valid)
    new, info = step(eqx.tree_at(lambda s: s.map, state, doubled(state.map, 1e-3)), exact(FRAME), FULL, settings)
    assert info.localization.is_tracked
    found = int(info.num_gaussians)
    assert found < 0.85 * 2 * len(held) < 2 * len(held) + info.refinement.num_fresh  # the others are out of sight


def small_steps(camera, num_frames, slab_frames=()):
    """Predictions along a fifth of the path's steps; in some a block of the image stands at half its depth."""
    y, x = np.divmod(np.arange(camera.height * camera.width), camera.width)
    is_slab = (abs(y - camera.height // 2) < 4) & (abs(x - camera.width // 2) < 6)
    before = FRAME - 1.0
    for k in range(num_frames):
        i = FRAME + 0.2 * k
        views = sc.stack_poses([sc.path_pose(j) for j in (before, i, i + 0.2)])
        seen = sc.observe_room(sc.path_pose(before), camera, num_features=2)
        prediction = eqx.tree_at(lambda p: (p.previous, p.T_world_views), exact(i), (seen, views))
        if k in slab_frames:
            points = np.where(is_slab[:, None], 0.5, 1.0) * prediction.current.points
            prediction = eqx.tree_at(lambda p: p.current.points, prediction, sc.device(points))
        before = i
        yield prediction


def with_one_in_the_way(map, row, T, seen, existence):
    """The map with one more Gaussian in a free row, a quarter of the way to what the middle of a view shows."""
    matrix, middle = sc.matrix_of(T), np.asarray(seen.points)[12 * 32 + 16]
    there = matrix[:3, :3] @ middle + matrix[:3, 3]
    held, rows = np.asarray(map.gaussians.valid), np.arange(ROOM)
    assert not held[row]
    apart = np.linalg.norm(map.gaussians.means - there, axis=1)
    rows[row] = np.where(held, apart, np.inf).argmin()  # of the normal of what is behind it
    more = jax.tree.map(sc.device, sc.rows_of(map, rows))
    means, beliefs = np.array(more.gaussians.means), np.array(more.existence)
    means[row], beliefs[row] = matrix[:3, 3] + 0.25 * (there - matrix[:3, 3]), existence
    return eqx.tree_at(lambda m: (m.gaussians.means, m.existence), more, (sc.device(means), sc.device(beliefs)))


def test_a_new_gaussian_may_take_the_row_of_one_that_the_same_frame_refutes(state, settings):
    held = int(np.sum(state.map.gaussians.valid))
    doubtful = float(settings.existence.refuted) + 0.1
    map = with_one_in_the_way(state.map, held, sc.path_pose(FRAME), exact(FRAME).current, doubtful)
    new, info = step(eqx.tree_at(lambda s: s.map, state, map), exact(FRAME), FULL, settings)
    assert info.num_gaussians == held + info.refinement.num_fresh > held
    assert new.map.gaussians.valid[held] and new.map.birth[held] == state.time


def test_both_halves_of_what_is_split_are_in_the_map(state, settings):
    """Where every Gaussian with a point is too coarse."""
    config = sc.changed(settings, **{f"splitting.{name}": 0.0 for name in ("color_std", "num_std", "min_points")})
    _, info = step(state, exact(FRAME), FULL, config)
    held = int(np.sum(state.map.gaussians.valid))
    assert info.num_gaussians - held - info.refinement.num_fresh > 0.3 * held


@pytest.mark.slow
def test_what_moves_is_as_if_it_had_no_points_but_hides_what_is_seen_through_and_is_the_next_frames(window, camera):
    """A slab at half the depth after four frames without it, in a prediction whose lengths are half the map's."""
    config = lenient("slam/motion=default", "slam.motion.num_looks=3")
    state, _ = init_state(window.views, window.T_world_views, FULL, config)
    for prediction in small_steps(camera, 4):
        state, info = step(state, prediction, FULL, config)
        assert not info.moving.any()
    *_, clean = small_steps(camera, 5)
    *_, now = small_steps(camera, 5, slab_frames=(4,))
    is_slab = np.asarray(now.current.points != clean.current.points).any(1).reshape(camera.height, camera.width)
    images = lambda p: (p.current.points, p.previous.points)  # noqa: E731
    now = eqx.tree_at(images, now, tuple(0.5 * points for points in images(now)))
    row = ROOM - 1
    map = with_one_in_the_way(state.map, row, sc.path_pose(FRAME + 0.8), clean.current, 0.5)
    state = eqx.tree_at(lambda s: s.map, state, map)

    new, info = step(state, now, FULL, config)
    moving = np.asarray(info.moving)
    assert (
        moving[is_slab].mean() > 0.6 and not moving[np.abs(np.indices(moving.shape)[0] - camera.height // 2) > 6].any()
    )
    moving = moving.ravel()
    without = eqx.tree_at(lambda p: p.current.valid, now, sc.device(~moving))
    other, _ = step(state, without, FULL, config)
    assert info.localization.is_tracked
    sc.assert_same(new.T_world_previous, other.T_world_previous)
    sc.assert_same(new.map.gaussians, other.map.gaussians)
    sc.assert_same(new.map.weight, other.map.weight)
    assert new.previous.valid.all() and not other.previous.valid[moving].any()
    change = [float(s.map.existence[row]) - 0.5 for s in (new, other)]
    np.testing.assert_allclose(change, [-config.existence.miss, 0.0], atol=1e-6)
    np.testing.assert_array_equal(new.looks.moving[0], moving)
    depth = np.asarray(new.looks.depth[0]).reshape(2, *is_slab.shape)[:, camera.height // 2, camera.width // 2]
    slab = np.asarray(now.current.points)[is_slab.ravel(), 2] * float(info.localization.scale)
    assert (depth > 0.99 * slab.min()).all() and (depth < 1.01 * slab.max()).all()
    relative = new.T_world_previous.inverse() @ state.T_world_previous
    assert max(sc.pose_error(jaxlie.SE3(new.looks.T_previous_look.wxyz_xyz[1]), relative)) < 1e-6


def test_a_look_that_is_over_takes_back_what_it_has_said_where_later_frames_show_that_something_moved(window, camera):
    """Later frames have seen through a block of the oldest of three looks; a frame without points ends no look."""
    config = lenient("slam/motion=default", "slam.motion.num_looks=3")
    state, _ = init_state(window.views, window.T_world_views, FULL, config)
    for prediction in small_steps(camera, 4):
        state, _ = step(state, prediction, FULL, config)
    *_, now = small_steps(camera, 5)
    rows, columns = np.indices((camera.height, camera.width))
    is_block = ((abs(rows - camera.height // 2) < 5) & (abs(columns - camera.width // 2) < 5)).ravel()
    evidence = lambda s: (s.looks.log_odds, s.looks.step)  # noqa: E731
    told = tuple(
        leaf.at[-1].set(np.where(is_block, np.float32(x), leaf[-1]))
        for leaf, x in zip(evidence(state), (-99.0, 9.0), strict=True)
    )
    other = eqx.tree_at(evidence, state, told)
    (plain, _), (new, info) = (step(s, now, FULL, config) for s in (state, other))
    assert info.seen.time == state.looks.time[-1] and new.looks.time[-1] == state.looks.time[-2]
    moves = np.asarray(info.seen.moves)
    assert moves[is_block].mean() > 0.6 and not moves[np.abs(rows - camera.height // 2).ravel() > 6].any()
    lost = np.asarray(plain.map.existence - new.map.existence)[np.asarray(plain.map.gaussians.valid)]
    is_back = lost > 1e-6
    np.testing.assert_allclose(lost[is_back], config.existence.hit + config.existence.miss, rtol=1e-5)
    assert 0 < is_back.sum() < 0.5 * len(is_back)
    sc.assert_same(new.map.gaussians.means, plain.map.gaussians.means)

    empty = eqx.tree_at(lambda p: p.current.valid, now, sc.device(np.zeros(now.current.valid.shape, bool)))
    after, info = step(other, empty, FULL, config)
    assert info.seen.time == -1 and not info.seen.moves.any()
    np.testing.assert_array_equal(after.looks.time, state.looks.time)


def test_a_frame_is_aligned_with_what_is_confirmed_alone(state, settings):
    """What is confirmed stands 5 cm before the walls, what is not where they are."""
    held = np.flatnonzero(state.map.gaussians.valid)
    beside, both = np.arange(len(held)) + len(held), doubled(state.map, 0.0)
    means, beliefs, valid = (np.array(x) for x in (both.gaussians.means, both.existence, both.gaussians.valid))
    means[held] += 0.05 * np.asarray(both.gaussians.normals)[held]
    leaves, found = lambda m: (m.gaussians.means, m.existence, m.gaussians.valid), []  # noqa: E731
    for is_there, belief in ((False, 0.0), (True, 0.0), (True, 1.0)):
        valid[beside], beliefs[beside] = is_there, belief
        given = eqx.tree_at(leaves, both, tuple(sc.device(x) for x in (means, beliefs, valid)))
        _, info = step(eqx.tree_at(lambda s: s.map, state, given), exact(FRAME), FULL, settings)
        found.append(float(info.localization.depth_noise))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3)  # roundings
    assert found[2] < 0.5 * found[0]


def test_a_step_works_on_the_map_where_the_frame_before_was_and_where_this_one_is(state, settings):
    """Each shows another half of the room; where the next camera will be does not matter."""
    near = sc.at(settings, "submap.margin", 0.1)
    prediction = exact(FRAME)
    is_left = np.arange(768) % 32 < 16
    views = np.array(prediction.T_world_views.wxyz_xyz)
    views[2, 4:] += 50.0
    shown = eqx.tree_at(
        lambda p: (p.current.valid, p.T_world_views), prediction, (sc.device(is_left), jaxlie.SE3(sc.device(views)))
    )
    begun = eqx.tree_at(lambda s: s.previous.valid, state, sc.device(~is_left))
    _, info = step(begun, shown, FULL, near)
    _, whole = step(begun, shown, FULL, settings)
    assert whole.em.num_fused > 100 and info.em.num_fused > 0.9 * whole.em.num_fused


def test_a_step_is_the_same_elsewhere_and_in_other_rows(state, settings):
    """60 m off, as far as the gates do not hang on roundings; and with the map's rows from the last to the first."""
    prediction = noisy_prediction(FRAME, sc.THINNED, np.random.default_rng(0))
    off = np.float32([48.0, -32.0, 16.0])
    shift = lambda T: jaxlie.SE3(sc.device(np.asarray(T.wxyz_xyz) + np.append(np.zeros(4, np.float32), off)))  # noqa: E731
    placed = lambda s: (s.map.gaussians.means, s.previous.points, s.T_world_previous)  # noqa: E731
    layers = eqx.tree_at(lambda s: s.map, state, doubled(state.map, 0.12))  # too far apart to be one
    means, points, T = placed(layers)
    far = eqx.tree_at(placed, layers, (means + off, points + off, shift(T)))
    poses = lambda p: (p.T_world_views, p.T_world_anchor)  # noqa: E731
    seen = eqx.tree_at(poses, prediction, tuple(map(shift, poses(prediction))))
    reverse = eqx.tree_at(lambda s: s.map, state, jax.tree.map(sc.device, sc.rows_of(state.map, slice(None, None, -1))))
    begun = (layers, prediction), (far, seen), (state, prediction), (reverse, prediction)
    (_, info), (_, of_far), (here, plain), (reversed_, _) = (step(*given, FULL, settings) for given in begun)
    assert plain.localization.is_tracked and info.localization.is_tracked and info.em.num_fused > 300
    assert max(sc.pose_error(shift(info.T_world_camera), of_far.T_world_camera)) < 1e-3
    assert abs(int(of_far.em.num_fused) - int(info.em.num_fused)) <= 8, "of 768 points"
    assert abs(int(of_far.num_gaussians) - int(info.num_gaussians)) <= 2
    held = np.asarray(state.map.gaussians.valid)
    one, other = (
        sc.rows_of(map, rows) for map, rows in ((here.map, held), (reversed_.map, np.flatnonzero(held[::-1])[::-1]))
    )
    np.testing.assert_array_equal(other.gaussians.valid, one.gaussians.valid)
    np.testing.assert_allclose(other.weight, one.weight, rtol=1e-3)


def test_candidates_come_from_the_points_that_em_left_over(stepped):
    """One for every eighth of them, λ of this config."""
    _, info = stepped
    left = 768 - int(info.em.num_fused)
    assert 0 < info.refinement.num_candidates <= left / 8 + 1 < 768 / 8


def test_a_new_gaussian_weighs_as_many_images_as_its_points_amount_to_or_one_as_printed(state, settings):
    """Clusters hold some number of points, of which λ are one image's; in all no more than there are."""
    held = np.asarray(state.map.gaussians.valid)
    # So that EM and the image plane fuse nothing, and no row becomes free.
    apart = sc.changed(settings, **{"em.max_mahalanobis_sq": 0.0, "refinement.max_mahalanobis_sq_2d": 0.0})
    apart = sc.at(apart, "existence.refuted", -np.inf)
    new, info = step(state, exact(FRAME), FULL, apart)
    fresh = np.asarray(new.map.gaussians.valid) & ~held
    assert info.em.num_fused == 0 and fresh.sum() == info.refinement.num_fresh > 50
    weight = np.asarray(new.map.weight)[fresh]
    np.testing.assert_allclose(8 * weight, np.round(8 * weight), atol=1e-4)
    assert weight.std() > 0.05 and 0.8 * 768 < 8 * weight.sum() <= 768.01
    printed, _ = step(state, exact(FRAME), FULL, sc.at(apart, "em.average.gain", 0))
    np.testing.assert_array_equal(np.asarray(printed.map.weight)[fresh], 1)


def test_a_frame_knows_whose_gaussians_it_was_placed_by_and_the_new_ones_know_theirs(state, settings):
    known = np.where(np.arange(ROOM) % 5 == 0, 9, 4).astype(np.int32)
    aged = eqx.tree_at(lambda s: (s.map.birth, s.time), state, (sc.device(known), sc.device(np.int32(20))))
    new, info = step(aged, exact(FRAME), FULL, settings)
    assert info.origin == 4 and new.time == 21
    was, now = np.asarray(state.map.gaussians.valid), np.asarray(new.map.gaussians.valid)
    birth = np.asarray(new.map.birth)
    assert (birth[now & ~was] == 20).all() and np.isin(birth[now & was], [4, 9, 20]).all()


def test_num_updates_counts_em_and_refinement_once_each(state, stepped):
    rise = np.asarray(stepped[0].map.num_updates) - np.asarray(state.map.num_updates)
    assert 1 <= rise.max() <= 2 and rise.min() == 0


def without_points(prediction: Prediction) -> Prediction:
    return eqx.tree_at(lambda p: p.current.valid, prediction, sc.device(np.zeros(768, bool)))


@pytest.mark.parametrize("loss", ["no point", "nan pose", "rejected"])
def test_a_frame_that_is_not_tracked_leaves_the_map_bit_for_bit(state, settings, loss):
    prediction, config = exact(FRAME), settings
    if loss == "no point":
        prediction = without_points(prediction)
    elif loss == "nan pose":
        nowhere = jaxlie.SE3(sc.device(np.full((3, 7), np.nan)))
        prediction = eqx.tree_at(lambda p: p.T_world_views, prediction, nowhere)
    else:
        config = sc.at(settings, "localization.max_residual", 0.0)
    new, info = step(state, prediction, FULL, config)
    assert not info.localization.is_tracked and info.localization.reason > 0
    assert info.em.num_fused == 0 and info.em.num_points == 0 and info.refinement.num_fresh == 0
    assert info.num_left_out == 0 and info.origin == state.time, "no point is one that no map can hold"
    sc.assert_same(new.map, state.map)
    # What is not to be mapped may still be what the next frame's coarse pose needs.
    seen = np.asarray(new.previous.valid)
    assert seen.all() if loss == "rejected" else not seen.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((new, info.T_world_camera, info.T_world_newest)))


def odd(name: str) -> Prediction:
    """With a number that no prior should say."""
    given = exact(FRAME)
    if name in COLOURS:
        colors = np.array(given.current.colors)
        colors[5] = COLOURS[name]
        return eqx.tree_at(lambda p: p.current.colors, given, sc.device(colors))
    if name in COVARIANCES:
        return eqx.tree_at(lambda p: p.pose_covariance, given, sc.device(np.stack([COVARIANCES[name]] * 2)))
    anchor = {"no rotation": np.zeros(7), "anchor beyond any map": np.array([1.0, 0, 0, 0, 1e30, 0, 0])}[name]
    return eqx.tree_at(lambda p: p.T_world_anchor, given, jaxlie.SE3(sc.device(anchor)))


COLOURS = {"colour": 1e30, "no colour": np.nan}  # the first is clipped
COVARIANCES = {
    "negative variance": np.diag([1.0, 1.0, 1.0, -1e-3, 1e-4, 1e-4]),
    "errors that are one and the same": np.ones((6, 6)),
    "the same, a hundred times as large": 1e4 * np.ones((6, 6)),
    "beyond float32's square": 1e30 * np.eye(6),
}


@pytest.mark.parametrize("coarse", ["fused", "anchored"])
@pytest.mark.parametrize("name", [*COLOURS, "no rotation", "anchor beyond any map", *COVARIANCES])
def test_whatever_a_prior_says_the_state_is_sound_and_the_next_frame_tracked(state, settings, name, coarse):
    config = sc.at(settings, "localization.coarse", COARSE.index(coarse))
    state, info = step(state, odd(name), FULL, config)
    assert info.num_left_out == (name == "no colour")
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, info.T_world_camera)))
    np.testing.assert_allclose(np.linalg.norm(state.T_world_previous.rotation().wxyz), 1.0, atol=1e-5)
    _, info = step(state, exact(FRAME + 1), FULL, config)
    assert info.localization.is_tracked


def test_a_step_after_a_lost_frame_is_tracked_again(state, settings):
    between, _ = step(state, without_points(exact(FRAME)), FULL, settings)
    _, info = step(between, exact(FRAME + 1), FULL, settings)
    assert info.localization.is_tracked
    # Over two frames, and the scale is not known either.
    assert sc.pose_error(info.T_world_camera, sc.path_pose(FRAME + 1))[0] < 0.07


def test_free_rows_of_the_map_and_invalid_points_change_nothing(state, settings):
    seen = np.arange(768) % 6 > 0
    views = lambda p: (p.current.valid, p.previous.valid)  # noqa: E731
    prediction = eqx.tree_at(views, exact(FRAME), (sc.device(seen), sc.device(seen)))
    clean, clean_info = step(state, prediction, FULL, settings)
    images = lambda p: (p.current, p.previous)  # noqa: E731
    bad_prediction = eqx.tree_at(images, prediction, tuple(sc.poisoned(o, seen, 1e6) for o in images(prediction)))
    bad_state = eqx.tree_at(lambda s: s.map, state, sc.poisoned(state.map, state.map.gaussians.valid, 1e6))
    bad, bad_info = step(bad_state, bad_prediction, FULL, settings)
    sc.assert_same(bad_info, clean_info)
    valid = np.asarray(clean.map.gaussians.valid)
    sc.assert_same(sc.rows_of(bad.map, valid), sc.rows_of(clean.map, valid))


def run(given, config):
    """State after a first window and its predictions, and what each step did."""
    first, following = opening(given[0], config)
    state, config = start(first, FULL, config)
    infos = []
    for prediction in [*following, *given[1:]]:
        state, info, config = advance(state, prediction, FULL, config)
        infos.append(info)
    return state, infos


def predictions(window, count):
    return [window, *(exact(FRAME + i, has_newest=i < count - 1) for i in range(count))]


@pytest.mark.parametrize("initialization", ["merged", "incremental"])
def test_a_run_follows_the_exact_path_reports_every_step_and_repeats_bit_for_bit(window, initialization):
    chosen = sc.slam_config(*WHOLE, f"slam.initialization={initialization}")
    results = []
    for _ in range(2):
        state, infos = run(predictions(window, 3), sc.at(chosen, "localization.max_residual", 1.0))
        results.append((state, [info.T_world_camera for info in infos]))
    sc.assert_same(*results)
    truth = [sc.path_pose(i) for i in range(1 if initialization == "incremental" else FRAME, FRAME + 3)]
    found = results[0][1]
    assert len(found) == len(truth)
    # Frames are 5 cm and 2 degrees apart: a pose that is late by one is nearer to its neighbour than to its own.
    assert max(sc.pose_error(T, t)[0] for T, t in zip(found, truth, strict=True)) < 0.02
    assert min(sc.pose_error(T, t)[0] for T, t in zip(found[1:], truth[:-1], strict=True)) > 0.03
    assert max(sc.pose_error(results[0][0].T_world_previous, found[-1])) < 1e-6


SURE = {"pose_covariance": np.tile(1e-8 * np.eye(6), (2, 1, 1)), "scale_std": np.float32(1e-4)}


def sloping(observation, camera):
    """Depths that are 8 % too small at the left of the image, and as much too large at the right."""
    slope = np.exp(np.linspace(-0.08, 0.08, camera.width))[None, :, None] * np.ones((camera.height, 1, 1))
    return sc.replace(observation, points=observation.points * slope.reshape(-1, 1))


def test_a_field_of_the_first_frames_fades_from_the_map(camera):
    """Three frames whose depths slope by 8 %, then eight that are exact, at exact poses: the map becomes their mean."""
    chosen = sc.changed(sc.slam_config(*WHOLE, "slam.em.average.gain=count"), **LENIENT)
    poses = [sc.path_pose(i) for i in range(FRAME)]
    views = [sloping(sc.observe_room(T, camera, num_features=2), camera) for T in poses]
    sequence = [sc.replace(exact(FRAME + i), **SURE) for i in range(8)]
    _, infos = run([sc.first_window(sc.stack(views), sc.stack_poses(poses)), *sequence], chosen)
    assert all(i.localization.is_tracked for i in infos)
    sizes = [float(np.abs(i.localization.icp.field.nodes).max()) for i in infos]
    assert 0.06 < sizes[0] < 0.1, "what the map differs from the frame"
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.5 * sizes[0], "3 of 11 frames are wrong"


# What a step is compiled for.

events = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: events.append(name))


def choices(module, prefix=""):
    """Dotted paths of the traced choice fields of a config and their number of names."""
    found = {}
    for name, field in module.__dataclass_fields__.items():
        value, path = getattr(module, name), f"{prefix}{name}"
        if isinstance(value, eqx.Module):
            found |= choices(value, f"{path}.")
        elif "choices" in field.metadata and not field.metadata.get("static"):
            found[path] = len(field.metadata["choices"])
    return found


def other_configs(settings):
    """Every number of the config another one, every reading in turn, numbers as YAML may have them, and a preset."""
    yield jax.tree.map(lambda x: sc.device(np.where(np.isfinite(x), np.asarray(x) * 1.1, 1.0)), settings)
    readings = choices(settings)
    assert {"localization.coarse", "em.support", "localization.icp.residual", "em.average.gain"} <= set(readings)
    for i in range(max(readings.values())):
        yield sc.changed(settings, **{path: min(i, count - 1) for path, count in readings.items()})
    for value in ("1", "2.5", "inf"):
        yield sc.slam_config(*WHOLE, f"slam.em.max_mahalanobis_sq={value}")
    yield sc.slam_config(*WHOLE, "slam/em=paper", "slam/localization=paper", "slam/refinement=paper")


def test_no_number_and_no_reading_of_the_config_traces_or_compiles_anything(state, stepped, settings):
    prediction, others = exact(FRAME), list(other_configs(settings))
    assert len(jax.tree.leaves(settings)) > 40 and any("compile" in name for name in events)
    for number, config in enumerate(others):
        before = len(events)
        jax.block_until_ready(step(state, prediction, FULL, config))
        assert not [name for name in events[before:] if "trace" in name or "compile" in name], number


# Room, and what a run begins with.


def test_room_is_doubled_where_rows_did_not_fit(settings):
    zero, some = (sc.device(np.int32(number)) for number in (0, 1))
    room = settings.submap.map_capacity, settings.submap.submap_capacity
    for map, submap in ((zero, zero), (some, zero), (zero, some), (some, some)):
        grown = grow_capacities(settings, Overflow(map, submap, some)).submap
        assert (grown.map_capacity, grown.submap_capacity) == (room[0] * (1 + int(map)), room[1] * (1 + int(submap)))


@pytest.mark.parametrize(
    ("stage", "place", "factors"),
    [("_store", lambda stored: stored[2], (2, 1)), ("_select", lambda submap: submap.overflow, (1, 2))],
)
def test_a_full_map_asks_for_room_in_the_map_and_a_full_submap_in_the_submap(
    state, settings, monkeypatch, stage, place, factors
):
    """The stage that finds room says that a row had none."""
    found = getattr(slam, stage)
    monkeypatch.setattr(slam, stage, lambda *given: eqx.tree_at(place, found(*given), sc.device(np.int32(1))))
    _, info = step(state, exact(FRAME), FULL, settings)
    grown, room = grow_capacities(settings, info.overflow).submap, settings.submap
    assert (grown.map_capacity / room.map_capacity, grown.submap_capacity / room.submap_capacity) == factors


def test_a_frame_is_repeated_from_the_same_state_until_it_fits(state, stepped, settings):
    """By a step that says so below four times the room; a splat without room alone repeats nothing."""
    calls, prediction = [], exact(FRAME)

    def crowded(given, _, __, chosen):
        calls.append((given, chosen.submap.map_capacity))
        lost = np.int32(chosen.submap.map_capacity < 4 * settings.submap.map_capacity)
        overflow = Overflow(*(sc.device(np.int32(number)) for number in (lost, 0, 1 + lost)))
        return given, eqx.tree_at(lambda i: i.overflow, stepped[1], overflow)

    _, info, chosen = advance(state, prediction, FULL, settings, crowded)
    assert isinstance(info, StepInfo) and [size for _, size in calls] == [ROOM, 2 * ROOM, 4 * ROOM]
    assert chosen.submap.map_capacity == 4 * ROOM and chosen.submap.submap_capacity == settings.submap.submap_capacity
    for given, size in calls:
        assert given.map.weight.shape == (size,)
        sc.assert_same(sc.rows_of(given.map, slice(ROOM)), jax.device_get(state.map))
        sc.assert_same(given.previous, state.previous)


def test_the_first_map_is_made_again_until_it_fits(state, window, settings):
    sizes = []

    def crowded(_, __, ___, chosen):
        sizes.append(chosen.submap.map_capacity)
        return state, sc.device(np.int32(chosen.submap.map_capacity < 4 * ROOM))

    started, chosen = start(window, FULL, settings, crowded)
    assert sizes == [ROOM, 2 * ROOM, 4 * ROOM] and chosen.submap.map_capacity == 4 * ROOM
    assert started is state


def test_a_window_opens_whole_or_view_by_view(window):
    """Each further view of an incremental start is a step's current frame, with the one before it and the next one."""
    first, following = opening(window, sc.slam_config("slam.initialization=merged"))
    assert first is window and following == []
    first, following = opening(window, sc.slam_config("slam.initialization=incremental"))
    view = lambda i: sc.rows_of(window.views, i)  # noqa: E731
    sc.assert_same(first, sc.rows_of(window, slice(1)))
    assert len(following) == FRAME - 1
    for i, p in enumerate(following, start=1):
        sc.assert_same((p.current, p.previous), (view(i), view(i - 1)))
        assert p.has_newest == (i < FRAME - 1)
        for row, j in enumerate((i - 1, i, min(i + 1, FRAME - 1))):
            assert max(sc.pose_error(jaxlie.SE3(np.asarray(p.T_world_views.wxyz_xyz)[row]), sc.path_pose(j))) < 1e-6
        assert max(sc.pose_error(p.T_world_anchor, sc.path_pose(0))) < 1e-6
    poses = np.array(window.T_world_views.wxyz_xyz)
    poses[1] = np.nan
    replaced = eqx.tree_at(lambda w: w.T_world_views, window, jaxlie.SE3(sc.device(poses)))
    with pytest.raises(ValueError, match="no pose"):
        opening(replaced, sc.slam_config("slam.initialization=merged"))
