"""Where a step begins once the camera is found; oracle: the pose and the unit that were found."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from loop_scene import matrix
from scene import assert_same, first_window, random_gaussians, random_observation

import emgs_jax
from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.device.arrays import to_se3
from emgs_jax.gaussian_map import new_map
from emgs_jax.localization import localize_coarse
from emgs_jax.loop_closure.relocalization import RelocalizedPose
from emgs_jax.mapping import tracking
from emgs_jax.mapping.atlas import Atlas, Submap, World, unvisited, with_state
from emgs_jax.mapping.run import new_run
from emgs_jax.mapping.tracking import (
    anchor_motion,
    anchor_world,
    as_step_prediction,
    begin,
    is_relocalization_due,
    is_restart_due,
    move_prediction,
    place_world,
    rejection,
    relocalized_start,
    return_to_world,
    step_event,
    step_prediction,
)
from emgs_jax.motion import no_looks
from emgs_jax.observation import Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import SlamState

pytestmark = pytest.mark.slow

load_config = cache(emgs_jax.load_config)  # nobody changes what it gives
localized = eqx.filter_jit(localize_coarse)
PLACE = matrix((10, -70, 20), (3.0, -2.0, 1.0))
FOUND_THERE = RelocalizedPose(PLACE, float(np.log(1.1)), 1e-4 * np.eye(7), 4)
CAMERA = Camera((5.0, 5.0), (2.0, 1.5), 5, 4)  # of 20 rows


def prediction() -> Prediction:
    poses = [matrix((0, 5 * k, 0), (0.1 * k, 0, 0.3)) for k in (1, 2, 3)]
    return Prediction(
        current=random_observation(20, seed=1),
        previous=random_observation(20, seed=2),
        T_world_views=to_se3(np.stack(poses)),
        T_world_anchor=to_se3(matrix((0, 0, 30), (1, 1, 1))),
        pose_covariance=jnp.tile(1e-4 * jnp.eye(6), (2, 1, 1)),
        scale_std=jnp.asarray(0.01),
        has_newest=jnp.asarray(True),
        is_repeat=jnp.asarray(True),
    )


def some_map():
    return new_map(random_gaussians(30), jnp.ones(30), jnp.ones(()), jnp.asarray(0, jnp.int32))


def saved(map) -> Submap:
    """A saved map of seven frames, before one is found in it."""
    end = SimpleNamespace(nodes=[None] * 7)
    one = SimpleNamespace(map=map, back_end=end, depth_noise=0.02, is_frozen=False)
    return unvisited(one, CAMERA, load_config().slam)


def lost_state() -> SlamState:
    estimate = replace(
        exact_estimate(), depth_noise=jnp.asarray(0.03), log_scale=jnp.asarray(0.2), num_scales=jnp.asarray(9.0)
    )
    return SlamState(some_map(), random_observation(20), jaxlie.SE3.identity(), estimate, jnp.asarray(12, jnp.int32))


@pytest.mark.parametrize("coarse", ["via_previous", "same_image", "anchored", "fused"])
def test_the_coarse_pose_of_the_step_is_where_the_camera_was_found(coarse):
    """By every reading: the frame before is this one, and the prior's world is moved to it."""
    config = load_config(f"slam.localization.coarse={coarse}").slam.localization
    state, again = relocalized_start(lost_state(), prediction(), FOUND_THERE)
    last = state.previous, state.T_world_previous
    pose = localized(again, *last, CAMERA, config, state.estimate)
    np.testing.assert_allclose(pose.T_world_camera.as_matrix(), PLACE, atol=1e-4)
    np.testing.assert_allclose(pose.scale, 1.1, rtol=2e-3)  # .1 from the mean so far, .01 against .1
    _, here, there = np.array(prediction().T_world_views.as_matrix())
    motion = np.linalg.inv(here) @ there
    motion[:3, 3] *= 1.1
    np.testing.assert_allclose(pose.T_world_newest.as_matrix(), PLACE @ motion, atol=1e-3)


def test_map_unit_and_time_of_a_lost_run_go_on():
    before = lost_state()
    state, again = relocalized_start(before, prediction(), FOUND_THERE)
    assert_same(state.map, before.map)
    assert not again.is_repeat  # it is its own previous frame
    assert int(state.time) == 12 and float(state.estimate.num_scales) == 9
    np.testing.assert_array_equal(state.estimate.log_scale, before.estimate.log_scale)
    np.testing.assert_allclose(state.estimate.covariance, FOUND_THERE.covariance)


def test_earlier_looks_stay_where_they_are_in_the_world():
    """They went with the camera to where it was found, and what stands there was taken for moving."""
    poses = to_se3(np.stack([matrix((0, 10 * k, 0), (0.2 * k, 0, 0)) for k in range(3)]))
    last = matrix((0, 20, 0), (1.0, 0, 2.0))
    motion = load_config("slam.motion.num_looks=3").slam.motion
    looks = replace(no_looks(random_observation(20), motion), depth=jnp.ones((3, 2, 20)), T_previous_look=poses)
    before = replace(lost_state(), T_world_previous=to_se3(last), looks=looks)
    state, _ = relocalized_start(before, prediction(), FOUND_THERE)
    there, expected = (np.asarray(x.as_matrix(), float) for x in (state.looks.T_previous_look, poses))
    np.testing.assert_allclose(PLACE @ there, last @ expected, atol=1e-5)
    np.testing.assert_array_equal(state.looks.depth, looks.depth)


def test_in_a_saved_map_the_unit_is_what_the_first_frame_found_says():
    state, _ = relocalized_start(saved(some_map()).state, prediction(), FOUND_THERE, is_same_unit=False)
    assert_same(state.map, some_map())
    assert int(state.time) == 7 and float(state.estimate.num_scales) == 1
    np.testing.assert_allclose([state.estimate.log_scale, state.estimate.depth_noise], [np.log(1.1), 0.02], rtol=1e-6)


def test_features_of_another_width_are_refused():
    wide = new_map(random_gaussians(30, num_features=8), jnp.ones(30), jnp.ones(()), jnp.asarray(0, jnp.int32))
    with pytest.raises(ValueError, match=r"width 8 and those of this run 0: use prior= and features="):
        relocalized_start(saved(wide).state, prediction(), FOUND_THERE)


def test_from_then_on_the_prior_says_its_poses_from_where_the_camera_was_found():
    given, scale = prediction(), jnp.asarray(1.1)
    motion = anchor_motion(given, to_se3(PLACE), scale)
    there = move_prediction(given, motion)
    anchor, current = (
        np.array(T.as_matrix()) for T in (there.T_world_anchor, jaxlie.SE3(there.T_world_views.wxyz_xyz[1]))
    )
    relative = np.linalg.inv(anchor) @ current
    relative[:3, 3] *= 1.1  # as `localize_coarse` scales it
    np.testing.assert_allclose(anchor @ relative, PLACE, atol=1e-5)
    assert move_prediction(given, None) is given
    assert np.isnan(there.pose_covariance).all()  # that world is only as sure as the pose that was found
    anchored = anchor_world(World(), SimpleNamespace(world=0, prediction=given), PLACE, 1.1)
    np.testing.assert_allclose(anchored.motion.wxyz_xyz, motion.wxyz_xyz, atol=1e-6)


def test_a_frame_of_its_own_is_where_the_camera_was_found_and_goes_with_it_from_then_on():
    own = matrix((0, 40, 0), (1, 2, 3))
    given = SimpleNamespace(world=2, frames=[SimpleNamespace(index=5)], T_anchor_views={5: own})
    world = anchor_world(World(), given, PLACE, 1.1)
    np.testing.assert_allclose(world.T_world_prior @ own, PLACE, atol=1e-12)
    assert world.number == 2
    np.testing.assert_allclose(world.motion.as_matrix(), np.eye(4))  # None would stay behind in a closure


def in_own_world(world: int = 2) -> SimpleNamespace:
    """An input of frame 5, whose prior says the poses of three frames in a world of its own."""
    own = {row: matrix((0, 10 * row, 0), (0.1 * row, 2, 3)) for row in (4, 5, 6)}
    return SimpleNamespace(world=world, prediction=prediction(), frames=[SimpleNamespace(index=5)], T_anchor_views=own)


def test_in_a_world_that_was_placed_the_prior_says_the_poses_of_its_frames_in_the_map():
    given = in_own_world()
    found, own = step_prediction(place_world(given, PLACE), given), given.T_anchor_views
    expected = [PLACE @ np.linalg.inv(own[5]) @ own[row] for row in (4, 5, 6)]
    np.testing.assert_allclose(found.T_world_views.as_matrix(), expected, atol=1e-5)
    np.testing.assert_allclose(found.T_world_anchor.as_matrix(), PLACE, atol=1e-5)


def a_graph() -> BackEnd:
    return BackEnd(load_config("graph=default").graph, (1.0, 1.0, 0.0, 0.0), 0.0, (Node(PLACE, PLACE, 0.0, 0),))


def test_a_world_that_comes_back_goes_on_at_the_time_of_the_run_and_knows_no_frame_before():
    before = replace(lost_state(), time=jnp.asarray(5))
    submaps = {0: Submap(before, worlds={0: World()}), 1: Submap(lost_state())}
    atlas = Atlas(None, load_config().slam, replace(a_graph(), active=1), submaps, World(1))
    found = return_to_world(atlas, in_own_world(0))
    assert (found.graph.active, found.world.number, int(found.state.time)) == (0, 0, 12)
    assert before.previous.valid.any() and not found.state.previous.valid.any()
    assert found.submaps[1].worlds == {1: World(1)}, "where the run has been comes back, too"


def test_a_map_of_its_own_is_of_the_frame_that_the_run_has_come_to(monkeypatch):
    """Births are nodes: that of the frame before would move the new map with the old one."""
    alone = replace(lost_state(), time=jnp.asarray(1))
    monkeypatch.setattr(tracking, "start", lambda first, camera, config: (alone, config))
    atlas = Atlas(None, load_config().slam, a_graph(), {0: Submap(lost_state())})
    found = begin(atlas, in_own_world())
    assert found.graph.active == 1 and int(found.state.time) == 12 + 1
    assert (np.asarray(found.state.map.birth) == 12).all()


@pytest.mark.parametrize(("is_frozen", "count"), [(False, 35), (True, 30)])
def test_in_a_map_that_stays_what_a_step_would_have_made_is_not_counted(is_frozen, count):
    of_step = SimpleNamespace(estimate=SimpleNamespace(covariance=np.eye(7)), by_map=np.eye(6), is_tracked=True)
    info = SimpleNamespace(T_world_camera=to_se3(PLACE), num_gaussians=35, origin=0, localization=of_step)
    atlas = Atlas(None, None, a_graph(), {0: Submap(lost_state(), is_frozen)})
    assert step_event(atlas, info).num_gaussians == count


def test_the_first_view_of_a_sequence_is_its_own_previous_one():
    views = jax.tree.map(lambda leaf: leaf[None], random_observation(20))
    found = as_step_prediction(first_window(views, to_se3(PLACE[None])))
    assert_same(found.current, random_observation(20))
    assert_same(found.previous, found.current)
    np.testing.assert_allclose(found.T_world_views.as_matrix(), [PLACE] * 3, atol=1e-5)
    assert as_step_prediction(prediction()).has_newest and not found.has_newest


@pytest.mark.parametrize(
    ("num_lost", "is_tracked", "expected"),
    [(2, False, True), (2, True, False), (1, False, False)],  # the third in a row
)
def test_a_camera_is_looked_for_after_some_frames_that_are_not_tracked(num_lost, is_tracked, expected):
    info = SimpleNamespace(localization=SimpleNamespace(is_tracked=is_tracked))
    end = SimpleNamespace(config=load_config("graph=default").graph)
    assert is_relocalization_due(Atlas(None, None, end, {0: None}, num_lost=num_lost), info) == expected
    assert is_relocalization_due(Atlas(None, None, end, {0: saved(some_map())}), None)
    assert not is_relocalization_due(Atlas(None, None, end), None), "there is no map yet"
    assert not is_relocalization_due(Atlas(None, None, SimpleNamespace(config=None), {0: None}, num_lost=9), info)


def begins_anew(
    chain=((3, 2), (4, 3), (5, 4), (6, 5)), here=(6, 7), repeat_rms=0.01, has_points=True, is_frozen=False, patience=5
) -> bool:
    """The last five of eight frames, the given one included, are not tracked; without changes all speaks for it."""
    config = load_config("graph=default", f"graph.relocalization.max_patience={patience}")
    poses = np.stack([matrix((0, 0, 0), (0.1 * k, 0, 0)) for k in range(8)])
    end = SimpleNamespace(
        nodes=[SimpleNamespace(is_placed=row < 3) for row in range(7)], config=config.graph, first_node=0
    )
    end.factors = [SimpleNamespace(a=a, b=b, is_loop=False) for a, b in chain]
    found = SimpleNamespace(is_tracked=False, repeat_rms=repeat_rms)
    state = lost_state()
    state = eqx.tree_at(lambda s: s.previous.valid, state, state.previous.valid & has_points)
    given = SimpleNamespace(frames=[SimpleNamespace(index=7)], T_anchor_views={view: poses[view] for view in here})
    return is_restart_due(
        SimpleNamespace(graph=end, num_lost=4, is_frozen=is_frozen, config=config.slam),
        given,
        state,
        SimpleNamespace(localization=found),
    )


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"patience": 6}, False),  # not yet
        ({"chain": ((4, 3), (5, 4), (6, 5))}, False),  # nothing leads from a frame that was placed
        ({"chain": ((3, 2), (4, 3), (5, 4))}, False),
        ({"chain": ((6, 2),)}, True),  # the prior had lost what is between
        ({"chain": ((6, 0),)}, False),  # the anchor
        ({"chain": ((3, 2), (6, 4), (5, 4))}, False),
        ({"here": (7,)}, False),
        ({"here": (6,)}, False),
        ({"repeat_rms": 1.0}, False),  # the prior says something else each time
        ({"has_points": False}, False),
        ({"is_frozen": True}, False),
    ],
)
def test_a_map_begins_anew_only_where_the_prior_leads_and_knows_what_it_sees(changes, expected):
    assert begins_anew(**changes) is expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, None),
        ({"is_tracked": False}, "fine_pose"),
        ({"inlier_fraction": 0.3}, "fine_pose"),
        ({"step_m": 1.0}, "fine_pose"),
        ({"step_rad": 0.1}, "fine_pose"),
    ],
)
def test_the_map_has_the_last_word(changes, expected):
    values = {"is_tracked": True, "inlier_fraction": 0.8, "step_m": 0.01, "step_rad": 0.01} | changes
    found = SimpleNamespace(icp=SimpleNamespace(inlier_fraction=values.pop("inlier_fraction")), **values)
    config = load_config("graph=default").graph.relocalization
    assert rejection(SimpleNamespace(localization=found), prediction(), FOUND_THERE, config) == expected


def test_a_first_window_as_a_whole_has_no_place_in_a_saved_map():
    frames = SimpleNamespace(intrinsics=(1.0, 1.0, 0.0, 0.0), size=(5, 4))
    slam = load_config("slam.initialization=merged").slam
    with pytest.raises(ValueError, match="use slam.initialization=incremental"):
        new_run(frames, slam, saved=SimpleNamespace(map=some_map(), back_end=None))


def test_a_map_that_stays_gets_the_room_of_the_others_and_keeps_its_rows():
    state = lost_state()
    before = Atlas(None, None, SimpleNamespace(active=0), {0: Submap(state, is_frozen=True)})
    configs = [SimpleNamespace(submap=SimpleNamespace(map_capacity=capacity)) for capacity in (30, 64)]
    other = replace(state, map=some_map(), time=jnp.asarray(13))
    same, larger = (with_state(before, other, config).state.map for config in configs)
    assert_same(same, state.map)
    assert larger.weight.shape == (64,) and int(larger.gaussians.valid.sum()) == 30
    assert_same(jax.tree.map(lambda leaf: leaf[:30], larger), state.map)
