"""Predictions to arrays; oracle: every view has a depth and a colour of its own, and every pose a place of its own."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hand_run import poses_along
from scene import matrix_of, pose, pose_of, slam_config

from emgs_jax.data.base import Frame
from emgs_jax.device.arrays import to_se3
from emgs_jax.mapping.convert import opening, to_camera, to_first_window, to_prediction
from emgs_jax.ops.camera import unproject
from emgs_jax.prior.base import PriorPrediction, Window

HEIGHT, WIDTH = 12, 16
DATASET = SimpleNamespace(intrinsics=(18.0, 17.0, 7.25, 5.5), size=(WIDTH, HEIGHT))
CONFIG = slam_config().observation
ANCHOR = np.array([[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0], [0.0, 0.0, 0.0, 1.0]])


def depth_of(index: int) -> float:
    return 2.0 + 0.5 * index


def frame(index: int) -> Frame:
    """An image of one colour, the frame's number."""
    return Frame(index, float(index), f"{index}.png", np.full((HEIGHT, WIDTH, 3), 10 * index, np.uint8))


def predicted(window: Window, num_features: int = 2) -> tuple[PriorPrediction, dict[int, Frame]]:
    """Walls before every dense view, farther with its number; view i stands i metres along the anchor's x."""
    camera, count = to_camera(DATASET), len(window.dense)
    points = np.stack([unproject(camera, jnp.full((HEIGHT, WIDTH), depth_of(index))) for index in window.dense])
    features = np.zeros((count, 3, 4, num_features), np.float16)
    features[..., 0] = 1.0
    confidence = np.stack([np.full((HEIGHT, WIDTH), 2.0 + index, np.float32) for index in window.dense])
    mask = np.ones((count, HEIGHT, WIDTH), bool)
    poses = poses_along(np.array(window.views, float))
    return PriorPrediction(window, poses, points, confidence, mask, features), {i: frame(i) for i in window.views}


def is_view(observation, index: int) -> bool:
    """Whether points, colours and confidence are those of a frame."""
    z, colors, confidence = observation.points[..., 2], observation.colors, observation.confidence
    valid = np.asarray(observation.valid)
    assert valid.all(), "a wall has normals everywhere"
    return bool(
        np.allclose(z, depth_of(index), rtol=1e-6)
        and np.allclose(colors, 10 * index / 255, rtol=1e-6)
        and np.allclose(confidence, 2.0 + index)
    )


def world(xs) -> np.ndarray:
    return ANCHOR @ poses_along(np.asarray(xs, float))


def assert_poses(T, expected) -> None:
    np.testing.assert_allclose(T.as_matrix(), expected, atol=4e-6)  # float32 of some ten metres


def test_the_camera_has_the_data_sets_intrinsics_and_size():
    camera = to_camera(DATASET)
    np.testing.assert_array_equal(camera.focal, [18.0, 17.0])
    np.testing.assert_array_equal(camera.center, [7.25, 5.5])
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("has_newest", [True, False])
def test_a_step_has_the_current_and_the_previous_view_and_their_poses_in_the_world(has_newest):
    views = (0, 3, 4, 5, 6) if has_newest else (0, 3, 4, 5)
    prediction, frames = predicted(Window(3, views, (4, 5), 5))
    step = to_prediction(prediction, frames, ANCHOR, CONFIG)
    assert is_view(step.current, 5) and is_view(step.previous, 4)
    assert bool(step.has_newest) == has_newest and bool(step.is_repeat)
    assert_poses(step.T_world_views, world([4, 5, 6 if has_newest else 5]))
    assert_poses(step.T_world_anchor, ANCHOR)
    np.testing.assert_allclose(step.current.features, np.broadcast_to([1.0, 0.0], step.current.features.shape))


def covariances(count: int) -> np.ndarray:
    """Of views, each its own."""
    factors = 0.01 * np.random.default_rng(0).normal(size=(count, 6, 6))
    return factors @ factors.mT


def test_a_step_knows_its_motion_as_well_as_both_poses_together_and_its_own_pose():
    """Against 20,000 draws of the errors of both poses."""
    prediction, frames = predicted(Window(3, (0, 3, 4, 5, 6), (4, 5), 5))
    turned = np.stack([matrix_of(pose((0, 0.3 * k, 0.1), (0.1 * k, 0, 1.0))) for k in range(5)])
    P = covariances(5)
    sure = replace(prediction, T_anchor_view=turned, pose_covariance=P)
    step = to_prediction(sure, frames, ANCHOR, CONFIG)
    rng = np.random.default_rng(1)
    draws = [rng.multivariate_normal(np.zeros(6), P[k], 20_000) for k in (2, 3)]
    before, here = (jaxlie.SE3.exp(draw.astype(np.float32)) for draw in draws)
    a, b = (pose_of(T) for T in turned[2:4])
    errors = np.asarray(((a.inverse() @ b).inverse() @ (a @ before).inverse() @ b @ here).log(), float)
    said = np.asarray(step.pose_covariance[0])
    units = np.sqrt(np.outer(np.diag(said), np.diag(said)))
    np.testing.assert_allclose(np.cov(errors.T) / units, said / units, atol=0.04)
    np.testing.assert_allclose(step.pose_covariance[1], P[3], rtol=1e-6)
    assert np.isnan(to_prediction(prediction, frames, ANCHOR, CONFIG).pose_covariance).all()


def test_how_sure_a_scale_is_comes_with_every_step():
    prediction, frames = predicted(Window(3, (0, 3, 4, 5, 6), (4, 5), 5))
    assert np.isnan(to_prediction(prediction, frames, ANCHOR, CONFIG).scale_std)
    assert to_prediction(replace(prediction, scale_std=0.02), frames, ANCHOR, CONFIG).scale_std == np.float32(0.02)
    first, images = predicted(FIRST)
    window, _ = to_first_window(replace(first, scale_std=0.02), images, ANCHOR, CONFIG)
    _, steps = opening(window, SimpleNamespace(initialization="incremental"))
    assert {float(step.scale_std) for step in steps} == {float(np.float32(0.02))}
    for wrong in (-0.1, np.nan):
        with pytest.raises(ValueError, match="scale_std"):
            to_prediction(replace(prediction, scale_std=wrong), frames, ANCHOR, CONFIG)


def test_the_steps_of_the_first_window_know_their_poses_as_well_and_say_nothing_twice():
    """They are of one answer: that the poses of one follow from those before says nothing of how right they are."""
    prediction, frames = predicted(FIRST)
    sure = replace(prediction, pose_covariance=covariances(len(FIRST.views)))
    window, _ = to_first_window(sure, frames, ANCHOR, CONFIG)
    _, steps = opening(window, SimpleNamespace(initialization="incremental"))
    assert len(steps) == len(FIRST.dense) - 1 and not any(step.is_repeat for step in steps)
    for row, step in enumerate(steps, start=1):
        here = FIRST.views.index(FIRST.dense[row])
        np.testing.assert_allclose(step.pose_covariance[1], sure.pose_covariance[here], rtol=1e-6)
        assert np.trace(step.pose_covariance[0]) > np.trace(step.pose_covariance[1])


@pytest.mark.parametrize("fault", ["shape", "asymmetric", "negative", "negative beside millimetres"])
def test_a_covariance_that_is_none_is_refused(fault):
    prediction, frames = predicted(FIRST)
    wrong = np.tile(np.eye(6), (len(FIRST.views), 1, 1))
    wrong = {
        "shape": wrong[1:],
        "asymmetric": wrong + np.eye(6, k=1),
        "negative": wrong - 2 * np.eye(6),
        "negative beside millimetres": wrong * np.repeat([1e6, -1e-3], 3),
    }[fault]
    with pytest.raises(ValueError, match="pose_covariance"):
        to_first_window(replace(prediction, pose_covariance=wrong), frames, ANCHOR, CONFIG)


def test_points_that_are_masked_or_not_sure_enough_are_not_valid():
    prediction, frames = predicted(Window(1, (0, 1, 2), (1, 2), 2))
    prediction.mask[1, :, :4] = False
    prediction.confidence[1, :, -4:] = 0.5 * float(CONFIG.min_confidence)
    step = to_prediction(prediction, frames, ANCHOR, CONFIG)
    valid = np.asarray(step.current.valid).reshape(HEIGHT, WIDTH)
    assert not valid[:, :4].any() and not valid[:, -4:].any() and valid[:, 6:10].all()


FIRST = Window(0, (0, 1, 2, 3), (0, 1, 2, 3), 3)


def test_the_first_window_is_all_its_views_in_order():
    window, usable = to_first_window(*predicted(FIRST), ANCHOR, CONFIG)
    assert usable == (0, 1, 2, 3)
    assert_poses(window.T_world_views, world(usable))
    for row, index in enumerate(usable):
        view = SimpleNamespace(**{name: getattr(window.views, name)[row] for name in vars(window.views)})
        assert is_view(view, index)


@pytest.mark.parametrize("since", [0, 2])
def test_a_map_starts_at_the_first_view_of_those_that_may_start_it(since):
    window, usable = to_first_window(*predicted(FIRST), ANCHOR, CONFIG, since)
    assert usable == tuple(range(since, 4))
    assert_poses(window.T_world_views, world(usable))
    assert window.views.valid.shape[0] == len(usable)


def test_a_view_without_a_pose_or_a_point_starts_no_map_but_may_follow():
    prediction, frames = predicted(FIRST)
    prediction.T_anchor_view[0, 0, 3] = np.nan
    prediction.mask[1] = False
    prediction.T_anchor_view[3] = np.nan
    window, usable = to_first_window(prediction, frames, ANCHOR, CONFIG)
    assert usable == (2, 3)
    assert_poses(jax_row(window.T_world_views, 0), world([2])[0])
    assert np.isnan(np.asarray(window.T_world_views.wxyz_xyz)[1]).all()
    prediction.mask[2:] = False
    assert to_first_window(prediction, frames, ANCHOR, CONFIG) == (None, ())


def jax_row(T, row):
    return type(T)(T.wxyz_xyz[row])


def test_a_matrix_that_is_not_finite_is_a_pose_of_nan_and_its_neighbours_are_themselves():
    matrices = np.stack([ANCHOR, ANCHOR, np.eye(4)])
    matrices[1, 2, 3] = np.inf
    found = np.asarray(to_se3(matrices).wxyz_xyz)
    assert np.isnan(found[1]).all()
    half = np.sqrt(0.5)
    np.testing.assert_allclose(found[0], [half, 0, 0, half, 5, 6, 7], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(found[2], [1, 0, 0, 0, 0, 0, 0], atol=1e-7)


@pytest.mark.parametrize("name", ["points", "confidence", "mask", "features"])
def test_arrays_that_are_not_of_the_images_size_are_named(name):
    prediction, frames = predicted(Window(1, (0, 1, 2), (1, 2), 2))
    wrong = {key: getattr(prediction, key) for key in ("points", "confidence", "mask", "features")}
    wrong[name] = wrong[name][:, :-1] if name != "features" else wrong[name][:1]
    wrong = PriorPrediction(prediction.window, prediction.T_anchor_view, **wrong)
    with pytest.raises(ValueError, match=f"the prior's {name} have shape .* at frame 2, expected"):
        to_prediction(wrong, frames, ANCHOR, CONFIG)
    with pytest.raises(ValueError, match=f"the prior's {name} have shape"):
        to_first_window(wrong, frames, ANCHOR, CONFIG)
