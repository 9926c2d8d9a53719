"""Whole steps and runs on the box room: exact poses, nothing fused when not tracked, growth that changes nothing, and a
map of noisy predictions that is better than they are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from scene import assert_same, at, move_gaussians, observe_room, path_pose, pose, pose_error, predict_room, stack_poses

from emgs_jax.gaussian_map import insert
from emgs_jax.observation import Prediction, transform
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.pytree import stack
from emgs_jax.running.convert import FirstWindow, opening
from emgs_jax.running.growth import advance, start, with_room
from emgs_jax.slam import Overflow, SlamState, StepInfo, init_state, step

FRAME = 3
pytestmark = pytest.mark.slow  # one compilation of the whole step is half a minute
# Every second row and column of the full images is kept, which are those of `camera`; 32 of their pixels make 8 rows.
FULL = Camera([40.0, 46.0], [29.0, 24.5], 64, 48)
# The whole map, so that the axis-aligned voxels choose the same Gaussians in every frame.
WHOLE = ("slam.submap.margin=100", "slam.observation.thin=2", "slam.fit.points_per_gaussian=2116")


@pytest.fixture(scope="module")
def window(camera):
    poses = [path_pose(i) for i in range(FRAME)]
    return FirstWindow(stack([observe_room(T, camera, num_features=2) for T in poses]), stack_poses(poses))


@pytest.fixture(scope="module")
def settings(config):
    """Merged initialisation, an exact chain, lenient checks: the room is coarse at this resolution."""
    chosen = config(
        *WHOLE, "slam.initialization=merged", "slam.localization.coarse=same_image", "slam.em.average.gain=count"
    )
    return at(at(chosen, "localization.max_residual", 1.0), "localization.min_eigenvalue", 0.0)


@pytest.fixture(scope="module")
def state(window, camera, settings):
    return init_state(window.views, window.T_world_views, FULL, settings)[0]


@pytest.fixture(scope="module")
def stepped(state, camera, settings):
    return step(state, predict_room(FRAME, camera, num_features=2), FULL, settings)


def test_the_first_state_holds_the_last_view_as_it_is_in_the_world(state, window, camera):
    expected = transform(path_pose(FRAME - 1), observe_room(path_pose(FRAME - 1), camera), jnp.ones(()))
    np.testing.assert_allclose(state.previous.points, expected.points, atol=1e-6)  # roundings
    assert max(pose_error(state.T_world_previous, path_pose(FRAME - 1))) < 1e-6
    assert state.map.gaussians.valid.sum() == 3 * 768 // (8 * 3)
    np.testing.assert_allclose(state.map.weight[state.map.gaussians.valid].sum(), 3 * 768 / 8, rtol=1e-5)  # of λ points


def test_an_exact_prediction_is_tracked_and_its_points_are_fused_or_become_gaussians(state, stepped):
    new, info = stepped
    assert info.localization.is_tracked
    # Pixels are 10 cm apart here: a coarse map pulls by a small part of that (R9); the prior holds against it.
    distance, angle = pose_error(info.T_world_camera, path_pose(FRAME))
    assert distance < 0.02 and angle < 0.01
    assert info.em.num_points == 768 and info.em.num_fused > 0.5 * 768
    assert info.num_gaussians == new.map.gaussians.valid.sum()
    assert info.num_gaussians == state.map.gaussians.valid.sum() + info.refinement.num_fresh
    assert_same(new.T_world_previous, info.T_world_camera)
    assert int(info.overflow.map) == int(info.overflow.submap) == 0
    assert max(pose_error(info.T_world_newest, path_pose(FRAME + 1))) < 5e-3  # the chain alone, which is exact


def test_the_frame_is_kept_as_it_was_aligned_for_the_next_step(stepped, camera):
    new, info = stepped
    current = predict_room(FRAME, camera, num_features=2).current
    expected = transform(info.T_world_camera, current, info.localization.scale)
    np.testing.assert_allclose(new.previous.points, expected.points, atol=1e-5)  # roundings, here and below
    np.testing.assert_allclose(new.previous.normals, expected.normals, atol=1e-5)


def test_two_layers_that_a_look_cannot_tell_apart_become_one(state, camera, settings):
    gaussians = state.map.gaussians
    beside = eqx.tree_at(lambda m: m.gaussians.means, state.map, gaussians.means + 1e-3 * gaussians.normals)
    doubled, _, overflow = insert(state.map, beside)
    assert overflow == 0 and doubled.gaussians.valid.sum() == 2 * gaussians.valid.sum()
    twice = eqx.tree_at(lambda s: s.map, state, doubled)
    new, info = step(twice, predict_room(FRAME, camera, num_features=2), FULL, settings)
    assert info.localization.is_tracked
    held, found = (int(m.gaussians.valid.sum()) for m in (doubled, new.map))
    assert found < 0.85 * held and found < held + info.refinement.num_fresh  # the others are out of sight


def small_steps(camera, num_frames, slab_frames=()):
    """Predictions along a fifth of the path's steps; in some a block of the image stands at half its depth."""
    y, x = np.divmod(np.arange(camera.height * camera.width), camera.width)
    is_slab = (abs(y - camera.height // 2) < 4) & (abs(x - camera.width // 2) < 6)
    before = FRAME - 1.0
    for k in range(num_frames):
        i = FRAME + 0.2 * k
        prediction = predict_room(i, camera, num_features=2)
        views = stack_poses([path_pose(j) for j in (before, i, i + 0.2)])
        seen = observe_room(path_pose(before), camera, num_features=2)
        prediction = eqx.tree_at(lambda p: (p.previous, p.T_world_views), prediction, (seen, views))
        if k in slab_frames:
            points = jnp.where(is_slab[:, None], 0.5 * prediction.current.points, prediction.current.points)
            prediction = eqx.tree_at(lambda p: p.current.points, prediction, points)
        before = i
        yield prediction


def test_a_slab_that_two_frames_show_is_gone_within_twenty_and_the_wall_behind_it_stays(state, camera, settings):
    """Beside the same steps without it. Gaussians of this room stand some 20 cm apart, the slab a metre before it."""

    def means_of(state):
        return np.asarray(state.map.gaussians.means)[np.asarray(state.map.gaussians.valid)]

    clean, state_with, counts = state, state, []
    for prediction in small_steps(camera, 22):
        clean, _ = step(clean, prediction, FULL, settings)
    for prediction in small_steps(camera, 22, slab_frames=(0, 1)):
        state_with, info = step(state_with, prediction, FULL, settings)
        assert info.localization.is_tracked
        apart = np.linalg.norm(means_of(state_with)[:, None] - means_of(clean), axis=-1)
        counts.append(int((apart.min(1) > 0.4).sum()))
    assert counts[1] >= 5 and counts[-1] == 0
    assert (apart.min(0) < 0.25).mean() >= 0.99


def test_candidates_come_from_the_points_that_em_left_over(stepped):
    """One for every eighth of them, λ of this config."""
    _, info = stepped
    left = 768 - int(info.em.num_fused)
    assert 0 < info.refinement.num_candidates <= left / 8 + 1 < 768 / 8


def test_a_new_gaussian_weighs_as_many_images_as_its_points_amount_to_or_one_as_printed(state, camera, settings):
    """Clusters hold some number of points, of which λ are one image's; in all no more than there are."""
    prediction, held = predict_room(FRAME, camera, num_features=2), np.asarray(state.map.gaussians.valid)
    elsewhere = eqx.tree_at(lambda c: c.em.max_mahalanobis_sq, settings, jnp.zeros(()))  # so that EM fuses nothing
    apart = at(elsewhere, "refinement.max_mahalanobis_sq_2d", 0.0)
    new, info = step(state, prediction, FULL, apart)
    fresh = np.asarray(new.map.gaussians.valid) & ~held
    assert info.em.num_fused == 0 and fresh.sum() == info.refinement.num_fresh > 50
    weight = np.asarray(new.map.weight)[fresh]
    np.testing.assert_allclose(8 * weight, np.round(8 * weight), atol=1e-4)
    assert weight.std() > 0.05 and 0.8 * 768 < 8 * weight.sum() <= 768.01
    printed, _ = step(state, prediction, FULL, at(apart, "em.average.gain", 0))
    np.testing.assert_array_equal(np.asarray(printed.map.weight)[fresh], 1)


def test_a_frame_knows_whose_gaussians_it_was_placed_by_and_the_new_ones_know_theirs(state, camera, settings):
    known = jnp.where(jnp.arange(state.map.birth.shape[0]) % 5 == 0, 9, 4).astype(jnp.int32)
    aged = eqx.tree_at(lambda s: (s.map.birth, s.time), state, (known, jnp.asarray(20, jnp.int32)))
    new, info = step(aged, predict_room(FRAME, camera, num_features=2), FULL, settings)
    assert info.origin == 4 and new.time == 21
    was, now = np.asarray(state.map.gaussians.valid), np.asarray(new.map.gaussians.valid)
    born = now & ~was
    assert (np.asarray(new.map.birth)[born] == 20).all()
    assert np.isin(np.asarray(new.map.birth)[now & was], [4, 9, 20]).all()


def test_num_updates_counts_em_and_refinement_once_each(state, stepped):
    rise = np.asarray(stepped[0].map.num_updates - state.map.num_updates)
    assert 1 <= rise.max() <= 2 and rise.min() == 0


@pytest.mark.parametrize("loss", ["no point", "nan pose", "rejected"])
def test_a_frame_that_is_not_tracked_leaves_the_map_bit_for_bit(state, camera, settings, loss):
    prediction, config = predict_room(FRAME, camera, num_features=2), settings
    if loss == "no point":
        prediction = eqx.tree_at(lambda p: p.current.valid, prediction, jnp.zeros(768, bool))
    elif loss == "nan pose":
        prediction = eqx.tree_at(
            lambda p: p.T_world_views, prediction, jaxlie.SE3(jnp.full((3, 7), jnp.nan, jnp.float32))
        )
    else:
        config = at(settings, "localization.max_residual", 0.0)
    new, info = step(state, prediction, FULL, config)
    assert not info.localization.is_tracked and info.localization.reason > 0
    assert info.em.num_fused == 0 and info.em.num_points == 0 and info.refinement.num_fresh == 0
    assert_same(new.map, state.map)
    # What is not to be mapped may still be what the next frame's coarse pose needs.
    assert new.previous.valid.all() if loss == "rejected" else not new.previous.valid.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((new, info.T_world_camera, info.T_world_newest)))


def test_a_step_after_a_lost_frame_is_tracked_again(state, camera, settings):
    lost = eqx.tree_at(lambda p: p.current.valid, predict_room(FRAME, camera, num_features=2), jnp.zeros(768, bool))
    between, _ = step(state, lost, FULL, settings)
    _, info = step(between, predict_room(FRAME + 1, camera, num_features=2), FULL, settings)
    assert info.localization.is_tracked
    assert (
        pose_error(info.T_world_camera, path_pose(FRAME + 1))[0] < 0.07
    )  # over two frames, and the scale is not known either


def errors_of(shape, rng):
    """A smooth image of errors of deviation 1, as predictions have them."""
    y, x = np.meshgrid(np.linspace(0, np.pi, shape[0]), np.linspace(0, np.pi, shape[1]), indexing="ij")
    waves = [(v, u) for v in range(3) for u in range(3)]
    weights = rng.normal(size=len(waves))
    image = sum(w * np.cos(v * y) * np.cos(u * x) for w, (v, u) in zip(weights, waves, strict=True))
    return (image / np.linalg.norm(weights) * 2).reshape(-1, 1)


def noisy(observation, camera, rng, depth_noise):
    """Depths that are wrong by a fraction, smoothly over the image."""
    factor = 1 + depth_noise * errors_of((camera.height, camera.width), rng)
    return eqx.tree_at(lambda o: o.points, observation, observation.points * jnp.asarray(factor, jnp.float32))


def noisy_prediction(i, camera, rng, depth_noise=0.02, scale_noise=0.02, pose_noise=(0.01, 0.005)):
    """One call's errors: a scale, depths of each image, and poses by centimetres and milliradians."""
    exact = predict_room(i, camera, scale=1 + scale_noise * rng.normal(), num_features=2)
    off = [pose(pose_noise[1] * rng.normal(size=3), pose_noise[0] * rng.normal(size=3)) for _ in range(3)]
    poses = jaxlie.SE3((exact.T_world_views @ stack_poses(off)).wxyz_xyz)
    images = (noisy(o, camera, rng, depth_noise) for o in (exact.current, exact.previous))
    return eqx.tree_at(lambda p: (p.current, p.previous, p.T_world_views), exact, (*images, poses))


def test_a_step_moves_with_a_rigid_motion_of_the_world(state, camera, settings):
    """With noisy depths, so that the noise along the rays from the camera, wherever that is, decides what is fused."""
    motion, one = pose((0.7, 0.2, -0.4), (1.0, -2.0, 0.5)), jnp.ones(())
    prediction = noisy_prediction(FRAME, camera, np.random.default_rng(0))
    stepped = step(state, prediction, FULL, settings)
    quiet = step(state, prediction, FULL, at(settings, "em.noise", 0.0))[1]
    assert stepped[1].localization.is_tracked and quiet.em.num_fused < stepped[1].em.num_fused
    moved_prediction = Prediction(
        prediction.current,
        prediction.previous,
        jaxlie.SE3((motion @ prediction.T_world_views).wxyz_xyz),
        motion @ prediction.T_world_anchor,
        prediction.has_newest,
        prediction.is_repeat,
    )
    map = eqx.tree_at(lambda m: m.gaussians, state.map, move_gaussians(motion, state.map.gaussians))
    moved_state = SlamState(
        map, transform(motion, state.previous, one), motion @ state.T_world_previous, state.belief, state.time
    )
    new, info = step(moved_state, moved_prediction, FULL, settings)
    # The solver ends within its tolerance of the same pose; points near a gate may pass it or not.
    assert max(pose_error(info.T_world_camera, motion @ stepped[1].T_world_camera)) < 2e-3
    assert abs(int(info.em.num_fused) - int(stepped[1].em.num_fused)) <= 0.02 * 768
    old = np.asarray(state.map.gaussians.valid)
    expected = move_gaussians(motion, stepped[0].map.gaussians)
    error = np.linalg.norm(np.asarray(new.map.gaussians.means - expected.means), axis=1)[old]
    assert np.median(error) < 2e-3 and np.quantile(error, 0.95) < 0.02


@pytest.mark.parametrize(
    "law",
    [
        {"depth_noise": 0.03, "scale_noise": 0.0, "pose_noise": (1e-4, 1e-4)},  # structure from motion
        {"depth_noise": 0.002, "scale_noise": 0.0, "pose_noise": (0.03, 0.015)},  # a depth camera in the hand
    ],
)
def test_poses_are_trusted_as_far_as_they_repeat_whatever_depths_do(window, camera, config, law):
    """By the law of the depths, as printed, the path of either prior is worse: nothing ties the two."""
    rng, count = np.random.default_rng(0), 15
    given = [window, *(noisy_prediction(FRAME + i, camera, rng, **law) for i in range(count))]
    chosen = at(config(*WHOLE, "slam.initialization=merged"), "localization.max_residual", 1.0)

    def error(shared):
        _, infos = run(given, FULL, at(chosen, "localization.pose_shared", shared))
        ends = [pose_error(info.T_world_camera, path_pose(FRAME + i))[0] for i, info in enumerate(infos)]
        return np.sqrt(np.mean(np.square(ends)))

    said, by_depths = error(0.75), error(1.0)
    assert said < 0.7 * by_depths


@pytest.mark.parametrize("poison", [1e6])
def test_free_rows_of_the_map_and_invalid_points_change_nothing(state, camera, settings, poison):
    def put(tree, valid):
        rows = lambda x: jnp.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, poison)  # noqa: E731
        return jax.tree.map(lambda x: rows(x) if x.dtype == jnp.float32 else x, tree)

    seen = jnp.arange(768) % 6 > 0
    views = lambda p: (p.current.valid, p.previous.valid)  # noqa: E731
    prediction = eqx.tree_at(views, predict_room(FRAME, camera, num_features=2), (seen, seen))
    clean, clean_info = step(state, prediction, FULL, settings)
    bad_prediction = eqx.tree_at(
        lambda p: (p.current, p.previous), prediction, (put(prediction.current, seen), put(prediction.previous, seen))
    )
    bad_state = eqx.tree_at(lambda s: s.map, state, put(state.map, state.map.gaussians.valid))
    bad, bad_info = step(bad_state, bad_prediction, FULL, settings)
    assert_same(bad_info, clean_info)
    valid = clean.map.gaussians.valid
    assert_same(*jax.tree.map(lambda x: x[valid], (bad.map, clean.map)))


def run(given, camera, config):
    """State after a first window and its predictions, and what each step did."""
    first, following = opening(given[0], config)
    state, config = start(first, camera, config)
    infos = []
    for prediction in [*following, *given[1:]]:
        state, info, config = advance(state, prediction, camera, config)
        infos.append(info)
    return state, infos


def predictions(window, camera, count):
    return [window, *(predict_room(FRAME + i, camera, has_newest=i < count - 1, num_features=2) for i in range(count))]


def test_growing_on_the_way_gives_the_same_map_as_starting_large(window, camera, config, settings):
    def mapped(capacity, submap):
        chosen = config(
            *WHOLE,
            *("slam.initialization=merged", "slam.localization.coarse=same_image", "slam.em.average.gain=count"),
            *(f"slam.submap.map_capacity={capacity}", f"slam.submap.submap_capacity={submap}"),
        )
        chosen = at(at(chosen, "localization.max_residual", 1.0), "localization.min_eigenvalue", 0.0)
        return run(predictions(window, camera, 3), FULL, chosen)

    small, infos = mapped(64, 64)
    large, large_infos = mapped(256, 192)
    count = int(large.map.gaussians.valid.sum())
    assert count > 96 and len(infos) == len(large_infos) == 3
    assert small.map.weight.shape[0] in (128, 256)
    assert all(int(i.overflow.map) == int(i.overflow.submap) == 0 for i in infos)
    for a, b in zip(jax.tree.leaves(small.map), jax.tree.leaves(large.map), strict=True):
        # Other shapes sum in another order.
        np.testing.assert_allclose(a[:count], b[:count], atol=1e-4)


@pytest.mark.parametrize("initialization", ["merged", "incremental"])
def test_a_run_follows_the_exact_path_reports_every_step_and_repeats_bit_for_bit(
    window, camera, config, initialization
):
    chosen = at(config(*WHOLE, f"slam.initialization={initialization}"), "localization.max_residual", 1.0)
    results = []
    for _ in range(2):
        state, infos = run(predictions(window, camera, 3), FULL, chosen)
        results.append((state, [info.T_world_camera for info in infos]))
    assert_same(*results)
    truth = [path_pose(i) for i in range(1 if initialization == "incremental" else FRAME, FRAME + 3)]
    found = results[0][1]
    assert len(found) == len(truth)
    # Frames are 5 cm and 2 degrees apart: a pose that is late by one is nearer to its neighbour than to its own.
    assert max(pose_error(T, t)[0] for T, t in zip(found, truth, strict=True)) < 0.02
    assert min(pose_error(T, t)[0] for T, t in zip(found[1:], truth[:-1], strict=True)) > 0.03
    assert max(pose_error(results[0][0].T_world_previous, found[-1])) < 1e-6


def off_walls(points):
    """Distance of world points to the nearest wall of the room."""
    points = np.asarray(points, float)
    return np.minimum(np.abs(points - reference.ROOM_LOW), np.abs(points - reference.ROOM_HIGH)).min(axis=-1)


def test_a_map_of_noisy_predictions_is_more_accurate_than_their_points(camera, settings, config):
    """Oracle: the room's walls, and the camera's path. The prior's points lie where its own poses put them."""
    chosen = config(*WHOLE, "slam.initialization=merged", "slam.em.average.gain=count")
    chosen = at(at(chosen, "localization.max_residual", 1.0), "localization.min_eigenvalue", 0.0)
    poses = [path_pose(i) for i in range(FRAME)]
    ratios = []
    for seed in range(6):  # few frames of a small world: one by itself says little
        rng, count = np.random.default_rng(seed), 8
        views = [noisy(observe_room(T, camera, num_features=2), camera, rng, 0.02) for T in poses]
        sequence = [noisy_prediction(FRAME + i, camera, rng) for i in range(count)]
        final, infos = run([FirstWindow(stack(views), stack_poses(poses)), *sequence], FULL, chosen)
        assert all(i.localization.is_tracked for i in infos)
        raw_poses = [jaxlie.SE3(p.T_world_views.wxyz_xyz[1]) for p in sequence]
        pairs = [*zip(poses, views, strict=True), *zip(raw_poses, (p.current for p in sequence), strict=True)]
        raw = np.concatenate([off_walls(transform(T, o, jnp.ones(())).points) for T, o in pairs])
        ours = off_walls(final.map.gaussians.means)[np.asarray(final.map.gaussians.valid)]
        ratios.append([np.median(ours) / np.median(raw), np.quantile(ours, 0.9) / np.quantile(raw, 0.9)])
    # Twelve frames see a wall, with errors that are independent but for the path's: a third is the most to hope for.
    assert np.all(np.mean(ratios, axis=0) < 0.7), ratios


def test_room_is_doubled_where_rows_did_not_fit(settings):
    zero, some, room = (
        jnp.zeros((), int),
        jnp.ones((), int),
        (settings.submap.map_capacity, settings.submap.submap_capacity),
    )
    for map, submap in ((zero, zero), (some, zero), (zero, some), (some, some)):
        grown = with_room(settings, Overflow(map, submap, some)).submap
        assert (grown.map_capacity, grown.submap_capacity) == (room[0] * (1 + map), room[1] * (1 + submap))


def test_a_frame_is_repeated_from_the_same_state_until_it_fits(state, stepped, camera, settings):
    """With a step that says so for a map of less than four times the room; a full tile alone repeats nothing."""
    calls, prediction = [], predict_room(FRAME, camera, num_features=2)

    def crowded(given, _, __, chosen):
        calls.append((given, chosen.submap.map_capacity))
        lost = jnp.asarray(chosen.submap.map_capacity < 4 * settings.submap.map_capacity, int)
        return given, eqx.tree_at(lambda i: i.overflow, stepped[1], Overflow(lost, 0 * lost, 1 + lost))

    _, info, chosen = advance(state, prediction, FULL, settings, crowded)
    assert isinstance(info, StepInfo) and [size for _, size in calls] == [256, 512, 1024]
    assert chosen.submap.map_capacity == 1024 and chosen.submap.submap_capacity == settings.submap.submap_capacity
    for given, size in calls:
        assert given.map.weight.shape == (size,)
        assert_same(jax.tree.map(lambda x: x[:256], given.map), state.map)
        assert_same(given.previous, state.previous)


def test_the_first_map_is_made_again_until_it_fits(state, window, camera, settings):
    sizes = []

    def crowded(_, __, ___, chosen):
        sizes.append(chosen.submap.map_capacity)
        return state, jnp.asarray(chosen.submap.map_capacity < 1000, int)

    started, chosen = start(window, FULL, settings, crowded)
    assert sizes == [256, 512, 1024] and chosen.submap.map_capacity == 1024
    assert started is state


def test_a_window_opens_whole_or_view_by_view(window, config):
    """Each further view of an incremental start is a step's current frame, with the one before it and the next one."""
    first, following = opening(window, config("slam.initialization=merged"))
    assert first is window and following == []
    first, following = opening(window, config("slam.initialization=incremental"))
    view = lambda i: jax.tree.map(lambda x: x[i], window.views)  # noqa: E731
    assert_same(first, jax.tree.map(lambda x: x[:1], window))
    assert len(following) == FRAME - 1
    for i, p in enumerate(following, start=1):
        assert_same((p.current, p.previous), (view(i), view(i - 1)))
        assert p.has_newest == (i < FRAME - 1)
        for row, j in enumerate((i - 1, i, min(i + 1, FRAME - 1))):
            assert max(pose_error(jaxlie.SE3(p.T_world_views.wxyz_xyz[row]), path_pose(j))) < 1e-6
        assert max(pose_error(p.T_world_anchor, path_pose(0))) < 1e-6
    lost = eqx.tree_at(lambda w: w.T_world_views, window, jaxlie.SE3(window.T_world_views.wxyz_xyz.at[1].set(jnp.nan)))
    with pytest.raises(ValueError, match="no pose"):
        opening(lost, config("slam.initialization=merged"))


def test_an_unknown_initialisation_is_refused(config):
    with pytest.raises(Exception, match="one of merged, incremental.*'random'"):
        config("slam.initialization=random")
