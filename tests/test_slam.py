"""Whole steps and runs on the box room: exact poses, nothing fused when not tracked, growth that changes nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scene import assert_same, at, move_gaussians, observe_room, path_pose, pose, pose_error, predict_room, stack_poses

from emgs_jax.observation import Prediction, transform
from emgs_jax.ops.pytree import stack
from emgs_jax.running.convert import FirstWindow, opening
from emgs_jax.running.growth import advance, start
from emgs_jax.slam import SlamState, init_state, step

one_step, first_state = eqx.filter_jit(step), eqx.filter_jit(init_state)
FRAME = 3
pytestmark = pytest.mark.slow  # one compilation of the whole step is half a minute
WHOLE = (
    "slam.submap.margin=100",
)  # the whole map, so that the axis-aligned voxels choose the same Gaussians in every frame


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
    return first_state(window.views, window.T_world_views, camera, settings)[0]


@pytest.fixture(scope="module")
def stepped(state, camera, settings):
    return one_step(state, predict_room(FRAME, camera, num_features=2), camera, settings)


def test_the_first_state_holds_the_last_view_as_it_is_in_the_world(state, window, camera):
    expected = transform(path_pose(FRAME - 1), observe_room(path_pose(FRAME - 1), camera), jnp.ones(()))
    np.testing.assert_allclose(state.previous.points, expected.points, atol=1e-6)  # roundings
    assert max(pose_error(state.T_world_previous, path_pose(FRAME - 1))) < 1e-6
    assert state.map.gaussians.valid.sum() == 3 * 768 // (8 * 3)


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
    new, info = one_step(state, prediction, camera, config)
    assert not info.localization.is_tracked and info.localization.reason > 0
    assert info.em.num_fused == 0 and info.em.num_points == 0 and info.refinement.num_fresh == 0
    assert_same(new.map, state.map)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((new, info.T_world_camera, info.T_world_newest)))


def test_a_step_after_a_lost_frame_is_tracked_again(state, camera, settings):
    lost = eqx.tree_at(lambda p: p.current.valid, predict_room(FRAME, camera, num_features=2), jnp.zeros(768, bool))
    between, _ = one_step(state, lost, camera, settings)
    _, info = one_step(between, predict_room(FRAME + 1, camera, num_features=2), camera, settings)
    assert info.localization.is_tracked
    assert pose_error(info.T_world_camera, path_pose(FRAME + 1))[0] < 0.05  # as above, over two frames


def test_a_step_moves_with_a_rigid_motion_of_the_world(state, stepped, camera, settings):
    motion, one = pose((0.7, 0.2, -0.4), (1.0, -2.0, 0.5)), jnp.ones(())
    prediction = predict_room(FRAME, camera, num_features=2)
    moved_prediction = Prediction(
        prediction.current,
        prediction.previous,
        jaxlie.SE3((motion @ prediction.T_world_views).wxyz_xyz),
        motion @ prediction.T_world_anchor,
        prediction.has_newest,
    )
    map = eqx.tree_at(lambda m: m.gaussians, state.map, move_gaussians(motion, state.map.gaussians))
    moved_state = SlamState(map, transform(motion, state.previous, one), motion @ state.T_world_previous)
    new, info = one_step(moved_state, moved_prediction, camera, settings)
    # The solver ends within its tolerance of the same pose; points near a gate may pass it or not.
    assert max(pose_error(info.T_world_camera, motion @ stepped[1].T_world_camera)) < 2e-3
    assert abs(int(info.em.num_fused) - int(stepped[1].em.num_fused)) <= 0.02 * 768
    old = np.asarray(state.map.gaussians.valid)
    expected = move_gaussians(motion, stepped[0].map.gaussians)
    error = np.linalg.norm(np.asarray(new.map.gaussians.means - expected.means), axis=1)[old]
    assert np.median(error) < 2e-3 and np.quantile(error, 0.95) < 0.02


@pytest.mark.parametrize("poison", [1e6])
def test_free_rows_of_the_map_and_invalid_points_change_nothing(state, camera, settings, poison):
    def put(tree, valid):
        rows = lambda x: jnp.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, poison)  # noqa: E731
        return jax.tree.map(lambda x: rows(x) if x.dtype == jnp.float32 else x, tree)

    seen = jnp.arange(768) % 6 > 0
    views = lambda p: (p.current.valid, p.previous.valid)  # noqa: E731
    prediction = eqx.tree_at(views, predict_room(FRAME, camera, num_features=2), (seen, seen))
    clean, clean_info = one_step(state, prediction, camera, settings)
    bad_prediction = eqx.tree_at(
        lambda p: (p.current, p.previous), prediction, (put(prediction.current, seen), put(prediction.previous, seen))
    )
    bad_state = eqx.tree_at(lambda s: s.map, state, put(state.map, state.map.gaussians.valid))
    bad, bad_info = one_step(bad_state, bad_prediction, camera, settings)
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
        return run(predictions(window, camera, 3), camera, chosen)

    small, infos = mapped(64, 64)
    large, large_infos = mapped(256, 128)
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
    chosen = config(
        *WHOLE,
        f"slam.initialization={initialization}",
        "slam.submap.map_capacity=256",
        "slam.submap.submap_capacity=128",
    )
    chosen = at(chosen, "localization.max_residual", 1.0)
    results = []
    for _ in range(2):
        state, infos = run(predictions(window, camera, 3), camera, chosen)
        results.append((state, [info.T_world_camera for info in infos]))
    assert_same(*results)
    truth = [path_pose(i) for i in range(1 if initialization == "incremental" else FRAME, FRAME + 3)]
    assert len(results[0][1]) == len(truth)
    assert max(pose_error(T, t)[0] for T, t in zip(results[0][1], truth, strict=True)) < 0.04  # 10 cm pixels


def test_an_unknown_initialisation_is_refused(config):
    with pytest.raises(Exception, match="merged or incremental.*'random'"):
        config("slam.initialization=random")
