"""The simulated prior against docs/priors.md: exact at level 0, and the stated statistics at level 1.

The tolerances of the empirical figures are three to four standard errors of the number of draws, with fixed seeds.
"""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Frame
from emgs_jax.prior.base import Window, windows
from emgs_jax.prior.simulated.prior import Simulated


def ask(prior, dataset, window):
    return prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)


def straight_line(num_frames, step=0.0):
    """Frames 8 × 6 without turns, `step` metres apart along x: their relative poses are known by heart."""
    frames = []
    for index in range(num_frames):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = step * index
        depth = np.full((6, 8), 2, np.float32)
        frames.append(Frame(index, 0.0, f"{index}", np.zeros((6, 8, 3), np.uint8), depth, T_world_camera))
    return frames


def true_poses(dataset, window):
    T = np.stack([dataset[i].T_world_camera for i in window.views])
    return np.linalg.inv(T[0]) @ T


def test_level_0_gives_the_true_poses_and_back_projected_depth(room):
    fx, fy, cx, cy = room.intrinsics
    for window in windows(len(room), 3):
        prediction = ask(Simulated(level=0, classes=room.classes), room, window)
        np.testing.assert_allclose(prediction.T_anchor_view, true_poses(room, window), atol=1e-9)
        for index, points, mask in zip(window.dense, prediction.points, prediction.mask, strict=True):
            depth = room[index].depth
            for row, column in [(0, 0), (2, 4), (3, 4), (15, 19), (29, 39)]:
                z = float(depth[row, column])
                exact = (column - cx) / fx * z, (row - cy) / fy * z, z
                np.testing.assert_allclose(points[row, column], exact, rtol=1e-6)  # float32 of the same number
            np.testing.assert_array_equal(points[..., 2], depth)
            np.testing.assert_array_equal(mask, depth > 0)


def test_level_0_gives_each_pixel_its_labels_embedding(room):
    prior = Simulated(level=0, feature_size=8, classes=room.classes)
    features = ask(prior, room, Window(0, (0, 1), (0, 1), 1)).features
    assert features.dtype == np.float16
    labels = room[1].labels
    expected = prior.text_features.astype(np.float16)[labels[labels >= 0]]
    np.testing.assert_array_equal(features[1][labels >= 0], expected)
    assert not features[1][labels == -1].any()


def digest(prediction):
    parts = prediction.T_anchor_view, prediction.points, prediction.confidence, prediction.mask, prediction.features
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_one_inference_alone_gives_the_bits_of_a_whole_run_in_any_order(room):
    calls = list(windows(len(room), 3))
    prior = Simulated(seed=3, classes=room.classes)
    forward = [digest(ask(prior, room, window)) for window in calls]
    backward = [digest(ask(prior, room, window)) for window in reversed(calls)][::-1]
    alone = [digest(ask(Simulated(seed=3, classes=room.classes), room, window)) for window in calls]
    assert forward == backward == alone
    assert len(set(forward)) == len(calls)
    assert digest(ask(Simulated(seed=4, classes=room.classes), room, calls[0])) != forward[0]


def test_the_geometry_of_a_view_does_not_depend_on_the_other_dense_views(room):
    one = ask(Simulated(), room, Window(2, (0, 2, 3), (3,), 3))
    two = ask(Simulated(), room, Window(2, (0, 2, 3), (2, 3), 3))
    np.testing.assert_array_equal(one.points[0], two.points[1])


def test_one_scale_multiplies_points_and_translations_of_an_inference(room):
    """With every other disturbance at zero, what is left is exp N(0, .03²), common to the inference."""
    log_scales = []
    for seed in range(300):
        prior = Simulated(seed=seed)
        rigid = dict.fromkeys(["window_translation", "window_rotation", "pair_translation", "pair_rotation"], 0.0)
        prior.standard = replace(prior.standard, **rigid, warp=(0.0, 0.0), pixel=0.0, flying_share=0.0)
        prediction = ask(prior, room, Window(4, (0, 2, 3), (2, 3), 3))
        scale = prediction.points[0, 10, 10, 2] / room[2].depth[10, 10]
        exact = true_poses(room, prediction.window)
        np.testing.assert_allclose(prediction.T_anchor_view[:, :3, :3], exact[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(prediction.T_anchor_view[:, :3, 3], scale * exact[:, :3, 3], rtol=1e-6)
        np.testing.assert_allclose(prediction.points[1, 5:, 5:, 2], scale * room[3].depth[5:, 5:], rtol=1e-6)
        log_scales.append(math.log(scale))
    assert np.std(log_scales) == pytest.approx(0.03, rel=0.13)


def errors(T_true, T_predicted):
    """Return (v, ω) of inv(T_true) · T_predicted, (…, 6)."""
    T = np.linalg.inv(T_true) @ T_predicted
    rotations = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    return np.concatenate([T[..., :3, 3], rotations], axis=-1)


def poses(seeds, window, step=0.0, **standard):
    """Return predicted poses (seeds, v, 4, 4) of straight-line frames, without the scale."""
    frames = straight_line(max(window.views) + 1, step)
    predicted = []
    for seed in seeds:
        prior = Simulated(seed=seed)
        prior.standard = replace(prior.standard, scale=0.0, **standard)
        predicted.append(prior.predict(window, [frames[i] for i in window.views], (9.0, 9.0, 4.0, 3.0)).T_anchor_view)
    return np.stack(predicted)


SEEDS = range(300)


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
        T = poses(range(3), window, pair_translation=0.0, pair_rotation=0.0)
        np.testing.assert_array_equal(T[:, 0], np.broadcast_to(np.eye(4), (3, 4, 4)))
        for view in range(2, len(window.views)):
            np.testing.assert_allclose(T[:, view], T[:, 1], atol=1e-12)  # all cameras are in one place here
        assert (np.abs(T[:, 1] - np.eye(4)).max(axis=(1, 2)) > 1e-3).all()


def test_each_pair_has_the_walks_error_and_it_accumulates_outward_from_the_middle():
    window = Window(9, (0, 5, 6, 7, 8, 9, 10), (9, 10), 10)  # the middle is frame 8
    T = poses(SEEDS, window, step=0.2, window_translation=0.0, window_rotation=0.0)
    for left in range(1, 6):
        T_pair = np.eye(4)
        T_pair[0, 3] = 0.2
        error = errors(T_pair, np.linalg.inv(T[:, left]) @ T[:, left + 1])
        np.testing.assert_allclose(error[:, :3].std(), 0.01, rtol=0.1)
        np.testing.assert_allclose(error[:, 3:].std(), math.radians(0.3), rtol=0.1)
    truth = np.tile(np.eye(4), (7, 1, 1))
    truth[1:, 0, 3] = 0.2 * np.arange(5, 11)
    rotation = errors(truth, T)[..., 3:].std(axis=(0, 2)) / math.radians(0.3)
    np.testing.assert_allclose(rotation, [0, 3**0.5, 2**0.5, 1, 0, 1, 2**0.5], rtol=0.12, atol=1e-6)


def test_70_percent_of_the_walks_variance_belongs_to_the_image_pair():
    """The error of the pair (6, 7) right and left of the middle of two inferences correlates by .7, with its sign."""
    right_of_middle, left_of_middle = Window(2, (0, 5, 6, 7), (6, 7), 7), Window(3, (0, 6, 7, 8), (7, 8), 8)
    a = poses(SEEDS, right_of_middle)
    b = poses(SEEDS, left_of_middle)
    error_a = errors(np.eye(4), np.linalg.inv(a[:, 2]) @ a[:, 3])
    error_b = errors(np.eye(4), np.linalg.inv(b[:, 1]) @ b[:, 2])
    for half in (np.s_[:, :3], np.s_[:, 3:]):
        assert np.corrcoef(error_a[half].ravel(), error_b[half].ravel())[0, 1] == pytest.approx(0.7, abs=0.07)


def test_scale_and_window_error_drift_from_inference_to_inference():
    """Stationary, and correlated by .9 to the power of the inferences between: neither constant nor fresh each time."""
    drifts = []
    for inference in (4, 5, 14):
        window, frames = Window(inference, (0, 1), (1,), 1), straight_line(2)
        rows = []
        for seed in range(400):
            prior = Simulated(seed=seed)
            still = dict.fromkeys(["pair_translation", "pair_rotation", "pixel", "flying_share"], 0.0)
            prior.standard = replace(prior.standard, **still, warp=(0.0, 0.0))
            prediction = prior.predict(window, frames, (9.0, 9.0, 4.0, 3.0))
            log_scale = math.log(prediction.points[0, 3, 4, 2] / 2.0)
            error = errors(np.eye(4), prediction.T_anchor_view[1])
            rows.append([log_scale / 0.03, *error[:3] / (0.015 * math.exp(log_scale)), *error[3:] / math.radians(0.5)])
        drifts.append(np.array(rows))
    for drift in drifts:
        np.testing.assert_allclose(drift.std(axis=0), 1.0, atol=0.13)
    for a, b, expected in ((0, 1, 0.9), (0, 2, 0.9**10)):
        correlation = [np.corrcoef(drifts[a][:, k], drifts[b][:, k])[0, 1] for k in range(7)]
        np.testing.assert_allclose(np.mean(correlation), expected, atol=0.05)


@pytest.mark.parametrize("settings", [{"level": -0.1}, {"level": math.nan}, {"seed": -1}, {"feature_size": 0}])
def test_settings_out_of_range_are_refused_by_name(settings):
    with pytest.raises(ValueError, match=f"prior.{next(iter(settings))}"):
        Simulated(**settings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_world_camera": None}, r"needs a data set with ground truth; use prior=recorded.*frame 1 \(1.png\)"),
        ({"depth": None}, r"prior=simulated needs a data set with ground truth; use prior=recorded.*frame 1 \(1.png\)"),
        ({"T_world_camera": np.full((4, 4), np.nan)}, r"frame 1 \(1.png\) must be a finite"),
        ({"depth": np.ones((3, 4), np.float32)}, r"frame 1 \(1.png\) must have its image's size"),
        ({"labels": np.full((30, 40), 2, np.int32)}, r"frame 1 \(1.png\) has label 2 of 2"),
        ({"index": 5}, "window.views"),
    ],
)
def test_a_frame_without_usable_truth_is_named(room, change, message):
    frames = [room[0], replace(room[1], **change), room[2]]
    with pytest.raises(ValueError, match=message):
        Simulated(classes=room.classes).predict(Window(1, (0, 1, 2), (1, 2), 2), frames, room.intrinsics)


def test_the_depth_of_a_view_that_is_not_dense_is_not_needed_and_changes_nothing(room):
    window = Window(1, (0, 1, 2), (0, 1), 1)
    frames = [room[0], room[1], replace(room[2], depth=None)]
    without = Simulated().predict(window, frames, room.intrinsics)
    assert digest(without) == digest(ask(Simulated(), room, window))


def test_a_data_set_without_ground_truth_is_refused_before_any_work(room):
    Simulated().check(room, 3)
    room.has_ground_truth = False
    with pytest.raises(ValueError, match="prior=simulated needs a data set with ground truth; use prior=recorded or"):
        Simulated().check(room, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": 1e9}, r"prior\.level must be from 0 .* to 100, got 1000000000\.0"),
        ({"level": float("nan")}, r"prior\.level must be from 0"),
        ({"seed": 1.5}, r"prior\.seed and prior\.feature_size must be whole numbers.*got 1\.5"),
        ({"feature_size": 0}, r"prior\.feature_size must be whole numbers.*and 0"),
    ],
)
def test_a_level_or_seed_that_makes_no_sense_is_refused(options, message):
    """A level of 1e9 gave depths that are not finite, and a seed of 1.5 was taken for 1."""
    with pytest.raises(ValueError, match=message):
        Simulated(**options)


def test_a_truth_without_any_depth_is_named_and_not_the_prior(room):
    """All of it was 0, and the error asked for another prior."""
    frames = [replace(room[i], depth=np.zeros_like(room[i].depth)) for i in range(3)]
    window = next(windows(3, 3))
    with pytest.raises(ValueError, match=r"0 of the first 3 images, from 0\.png on, have a true depth: it is 0 every"):
        Simulated().predict(window, frames, room.intrinsics)
    frames[1] = room[1]
    assert Simulated().predict(window, frames, room.intrinsics).mask.any(axis=(1, 2)).tolist() == [False, True, False]
