"""The simulated prior against docs/simulated.md: exact at level 0, and the stated statistics at level 1.

The tolerances of the empirical figures are three to four standard errors of the number of draws, with fixed seeds.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from draws import INTRINSICS, NO_DEPTH_NOISE, NO_PAIRS, SEEDS, along, ask, digest, errors, prior_with

from emgs_jax.prior.base import Window, windows
from emgs_jax.prior.simulated.prior import Simulated


def true_poses(dataset, window):
    T = np.stack([dataset[i].T_world_camera for i in window.views])
    return np.linalg.inv(T[0]) @ T


def test_level_0_gives_the_true_poses_back_projected_depth_and_each_pixel_its_labels_embedding(room):
    fx, fy, cx, cy = room.intrinsics
    prior = Simulated(level=0, feature_size=8, classes=room.classes)
    vectors = prior.text_features.astype(np.float16)
    for window in windows(range(len(room)).__contains__, 3):
        prediction = ask(prior, room, window)
        np.testing.assert_allclose(prediction.T_anchor_view, true_poses(room, window), atol=1e-9)
        assert prediction.features.dtype == np.float16
        for row, index in enumerate(window.dense):
            depth, labels, points = room[index].depth, room[index].labels, prediction.points[row]
            v, u = np.indices(depth.shape)
            exact = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=-1)
            np.testing.assert_allclose(points, exact, rtol=1e-6)  # float32 of the same number
            np.testing.assert_array_equal(prediction.mask[row], depth > 0)
            expected = np.where(labels[..., None] >= 0, vectors[labels], 0)
            np.testing.assert_array_equal(prediction.features[row], expected)


@pytest.mark.parametrize("version", [1, 2])
def test_one_inference_alone_gives_the_bits_of_a_whole_run_in_any_order(room, version):
    options = {"version": version, "classes": room.classes}
    calls, prior = list(windows(range(len(room)).__contains__, 3)), Simulated(seed=3, **options)
    forward = [digest(ask(prior, room, window)) for window in calls]
    backward = [digest(ask(prior, room, window)) for window in reversed(calls)][::-1]
    alone = [digest(ask(Simulated(seed=3, **options), room, window)) for window in calls]
    assert forward == backward == alone and len(set(forward)) == len(calls)
    assert digest(ask(Simulated(seed=4, **options), room, calls[0])) != forward[0]
    # A view depends neither on the other dense views nor on the depth of one that is not dense.
    one, two = (ask(Simulated(), room, Window(2, (0, 2, 3), dense, 3)) for dense in ((3,), (2, 3)))
    np.testing.assert_array_equal(one.points[0], two.points[1])
    frames = [replace(room[0], depth=None), replace(room[2], depth=None), room[3]]
    assert digest(Simulated().predict(one.window, frames, room.intrinsics)) == digest(one)


def test_one_scale_multiplies_points_and_translations_of_an_inference(room):
    """With every other disturbance at zero, what is left is exp N(0, .03²), common to the inference."""
    log_scales, still = [], NO_DEPTH_NOISE | NO_PAIRS | {"window_translation": 0.0, "window_rotation": 0.0}
    for seed in SEEDS:
        prediction = ask(prior_with(still, seed=seed), room, Window(4, (0, 2, 3), (2, 3), 3))
        scale = prediction.points[0, 10, 10, 2] / room[2].depth[10, 10]
        exact = true_poses(room, prediction.window)
        np.testing.assert_allclose(prediction.T_anchor_view[:, :3, :3], exact[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(prediction.T_anchor_view[:, :3, 3], scale * exact[:, :3, 3], rtol=1e-6)
        np.testing.assert_allclose(prediction.points[1, 5:, 5:, 2], scale * room[3].depth[5:, 5:], rtol=1e-6)
        log_scales.append(math.log(scale))
    assert np.std(log_scales) == pytest.approx(0.03, rel=0.13)


def poses(seeds, window, step=0.0, **standard):
    """Predicted poses (seeds, v, 4, 4) of straight-line frames, without the scale."""
    frames, predicted = along(max(window.views) + 1, step), []
    for seed in seeds:
        prior = prior_with(NO_DEPTH_NOISE | {"scale": 0.0} | standard, seed=seed)
        predicted.append(prior.predict(window, [frames[i] for i in window.views], INTRINSICS).T_anchor_view)
    return np.stack(predicted)


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_the_windows_middle_camera_has_the_window_error_times_one_plus_its_distance(step):
    window = Window(9, (0, 5, 6, 7), (6, 7), 7)  # the middle is frame 6
    T = np.eye(4)
    T[0, 3] = 6 * step
    error = errors(T, poses(SEEDS, window, step)[:, 2])
    factor = 1 + 6 * step
    np.testing.assert_allclose(error[:, :3].std(), factor * 0.015, rtol=0.1)
    np.testing.assert_allclose(error[:, 3:].std(), factor * math.radians(0.5), rtol=0.1)
    assert abs(error.mean()) < 0.003 * factor


def test_the_anchor_is_the_identity_and_all_other_views_carry_the_window_error_also_in_the_first_window():
    for window in (Window(0, tuple(range(10)), (9,), 9), Window(9, (0, 8, 9, 10), (9, 10), 10)):
        T = poses(range(3), window, **NO_PAIRS)
        np.testing.assert_array_equal(T[:, 0], np.broadcast_to(np.eye(4), (3, 4, 4)))
        for view in range(2, len(window.views)):
            np.testing.assert_allclose(T[:, view], T[:, 1], atol=1e-12)  # all cameras are in one place here
        assert (np.abs(T[:, 1] - np.eye(4)).max(axis=(1, 2)) > 1e-3).all()


def test_each_pair_has_the_walks_error_and_it_accumulates_outward_from_the_middle():
    window = Window(9, (0, 5, 6, 7, 8, 9, 10), (9, 10), 10)  # the middle is frame 8
    T = poses(SEEDS, window, step=0.2, window_translation=0.0, window_rotation=0.0)
    truth = np.tile(np.eye(4), (7, 1, 1))
    truth[1:, 0, 3] = 0.2 * np.arange(5, 11)
    for left in range(1, 6):
        error = errors(np.linalg.inv(truth[left]) @ truth[left + 1], np.linalg.inv(T[:, left]) @ T[:, left + 1])
        np.testing.assert_allclose(error[:, :3].std(), 0.01, rtol=0.1)
        np.testing.assert_allclose(error[:, 3:].std(), math.radians(0.3), rtol=0.1)
    rotation = errors(truth, T)[..., 3:].std(axis=(0, 2)) / math.radians(0.3)
    np.testing.assert_allclose(rotation, [0, 3**0.5, 2**0.5, 1, 0, 1, 2**0.5], rtol=0.12, atol=1e-6)


def test_70_percent_of_the_walks_variance_belongs_to_the_image_pair():
    """The error of the pair (6, 7) right and left of the middle of two inferences correlates by .7, with its sign."""
    a = poses(SEEDS, Window(2, (0, 5, 6, 7), (6, 7), 7))
    b = poses(SEEDS, Window(3, (0, 6, 7, 8), (7, 8), 8))
    error_a = errors(np.eye(4), np.linalg.inv(a[:, 2]) @ a[:, 3])
    error_b = errors(np.eye(4), np.linalg.inv(b[:, 1]) @ b[:, 2])
    for half in (np.s_[:, :3], np.s_[:, 3:]):
        assert np.corrcoef(error_a[half].ravel(), error_b[half].ravel())[0, 1] == pytest.approx(0.7, abs=0.07)


def test_scale_and_window_error_drift_from_inference_to_inference():
    """Stationary, and correlated by .9 to the power of the inferences between: neither constant nor fresh each time."""
    drifts = []
    for inference in (4, 5, 14):
        rows = []
        for seed in range(400):
            prior = prior_with(NO_DEPTH_NOISE | NO_PAIRS, seed=seed)
            prediction = prior.predict(Window(inference, (0, 1), (1,), 1), along(2), INTRINSICS)
            log_scale = math.log(prediction.points[0, 3, 4, 2] / 2.0)
            error = errors(np.eye(4), prediction.T_anchor_view[1])
            rows.append([log_scale / 0.03, *error[:3] / (0.015 * math.exp(log_scale)), *error[3:] / math.radians(0.5)])
        drifts.append(np.array(rows))
    for drift in drifts:
        np.testing.assert_allclose(drift.std(axis=0), 1.0, atol=0.13)
    for a, b, expected in ((0, 1, 0.9), (0, 2, 0.9**10)):
        correlation = [np.corrcoef(drifts[a][:, k], drifts[b][:, k])[0, 1] for k in range(7)]
        np.testing.assert_allclose(np.mean(correlation), expected, atol=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": -0.1}, r"prior\.level must be from 0 .* to 100, got -0\.1"),
        ({"level": 1e9}, r"prior\.level must be from 0 .* to 100, got 1000000000\.0"),  # depths were not finite
        ({"seed": -1}, r"prior\.seed and prior\.feature_size must be whole.*got -1"),
        ({"seed": 1.5}, r"prior\.seed and prior\.feature_size must be whole.*got 1\.5"),  # was taken for 1
        ({"feature_size": 0}, r"prior\.feature_size must be whole.*and 0"),
        ({"version": 3}, r"prior.version must be 1 .* or 2 .*, got 3"),
        ({"confusion": 1.5}, r"prior\.confusion is a probability"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        Simulated(**options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_world_camera": None}, r"needs a data set with ground truth; use prior=recorded.*frame 1 \(1.png\)"),
        ({"depth": None}, r"prior=simulated needs a data set with ground truth; use prior=recorded.*frame 1 \(1.png\)"),
        ({"labels": np.full((30, 40), 2, np.int32)}, r"frame 1 \(1.png\) has label 2 of 2"),
        ({"index": 5}, "window.views"),
    ],
)
def test_a_frame_without_usable_truth_is_named(room, change, message):
    frames = [room[0], replace(room[1], **change), room[2]]
    with pytest.raises(ValueError, match=message):
        Simulated(classes=room.classes).predict(Window(1, (0, 1, 2), (1, 2), 2), frames, room.intrinsics)


def test_a_data_set_without_ground_truth_is_refused_and_one_without_any_depth_is_named(room):
    """All of it was 0, and the error asked for another prior."""
    frames, window = (
        [replace(room[i], depth=np.zeros_like(room[i].depth)) for i in range(3)],
        next(windows(range(3).__contains__, 3)),
    )
    with pytest.raises(ValueError, match=r"0 of the first 3 images, from 0\.png on, have a true depth: it is 0 every"):
        Simulated().predict(window, frames, room.intrinsics)
    frames[1] = room[1]
    assert Simulated().predict(window, frames, room.intrinsics).mask.any(axis=(1, 2)).tolist() == [False, True, False]
    Simulated().check(room, 3)
    room.has_ground_truth = False
    with pytest.raises(ValueError, match="prior=simulated needs a data set with ground truth; use prior=recorded or"):
        Simulated().check(room, 3)
