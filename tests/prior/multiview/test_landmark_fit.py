"""Scale and shift from landmarks: known ones are found, with outliers, drift, jumps and few landmarks; wrong kinds."""

import hydra
import numpy as np
import pytest
from scene import compose

from emgs_jax.prior.multiview.landmark_fit import KINDS, fit_to_landmarks, smooth, to_depth
from emgs_jax.prior.multiview.landmarks import Landmarks

NUM_FRAMES, SLOPE, INTERCEPT = 24, 1.7, 0.2


def config(**changed):
    words = ("prior=multiview_stereo", "prior/dense=files", "prior.dense.folder=x")
    words += tuple(f"prior.dense.fit.{key}={value}" for key, value in changed.items())
    return hydra.utils.instantiate(compose(*words).prior.dense.fit)


def sequence(kind, log_scale, count=80, noise=0.0, outliers=0.0, stretched=False, seed=0):
    """What a network says at the landmarks of each frame, and these."""
    rng = np.random.default_rng(seed)
    values, landmarks = [], []
    for s in log_scale:
        z = 2.0 * np.exp(rng.normal(0, 0.35, count))
        u = (1 / z if kind == "affine_inverse" else z) * np.exp(rng.normal(0, noise, count) - s)
        is_wrong = rng.uniform(size=count) < outliers
        u[is_wrong] = rng.uniform(u.min(), u.max(), is_wrong.sum())
        v = (u - INTERCEPT * kind.startswith("affine")) / SLOPE
        values.append((v - v.min()) / np.ptp(v) if stretched else v)
        landmarks.append(Landmarks(np.zeros((count, 2)), z, np.full(count, 0.005), np.ones(count)))
    return values, landmarks


def fitted(values, landmarks, kind, **changed):
    return fit_to_landmarks(values, landmarks, np.arange(len(values)), kind, config(**changed))


def errors(fit, values, landmarks):
    """Median of log of the ratio of what is found to what is true, frame by frame."""
    ratios = [
        to_depth(v[None], fit, row)[0][0] / found.depth
        for row, (v, found) in enumerate(zip(values, landmarks, strict=True))
    ]
    return np.array([np.median(np.log(ratio[ratio > 0])) for ratio in ratios])


@pytest.mark.parametrize("kind", KINDS)
def test_an_exact_drift_is_found_with_the_kinds_own_parameters(kind):
    drift = np.cumsum(np.random.default_rng(1).normal(0, 0.02, NUM_FRAMES))
    values, landmarks = sequence(kind, drift)
    fit = fitted(values, landmarks, kind)
    np.testing.assert_allclose(errors(fit, values, landmarks), 0, atol=1e-3)
    for row in (0, NUM_FRAMES - 1):
        depth, std = to_depth(values[row][None], fit, row)
        np.testing.assert_allclose(depth[0], landmarks[row].depth, rtol=5e-3)
        assert 0 < std.max() < 0.05
    if not kind.startswith("affine"):
        assert np.abs(fit.parameters[:, 1]).max() < 1e-6


@pytest.mark.parametrize("kind", ["up_to_scale", "affine_inverse"])
def test_outliers_and_a_jump_of_the_scale_move_no_frame_by_two_percent(kind):
    """DepthCrafter's scale steps by 15 %; a walk that is too stiff smears it over the frames beside it."""
    jump = 0.15 * (np.arange(NUM_FRAMES) >= 12)
    values, landmarks = sequence(kind, jump, noise=0.03, outliers=0.2)
    fit = fitted(values, landmarks, kind)
    found = fit.parameters[:, 0] - fit.parameters[:, 0].mean()
    np.testing.assert_allclose(np.abs(found - (jump - jump.mean())).max(), 0, atol=0.03)
    # Of what is no outlier; the median of all moves with them.
    assert np.abs(errors(fit, values, landmarks)).max() < 0.02
    assert 0.02 < np.median(fit.std) < 0.08


def test_pictures_that_are_stretched_to_their_own_range_have_a_shift_each():
    values, landmarks = sequence("affine_inverse", np.zeros(NUM_FRAMES), stretched=True)
    fit = fitted(values, landmarks, "affine_inverse", num_steps=40)
    assert np.abs(errors(fit, values, landmarks)).max() < 0.01
    assert fit.step_std[0] > 0.05  # which no walk of a video has


def test_a_frame_without_landmarks_takes_its_neighbours_scale_and_is_less_sure():
    drift = np.linspace(0, 0.2, NUM_FRAMES)
    values, landmarks = sequence("up_to_scale", drift, noise=0.02)
    inside = slice(10, 14)
    few = [
        found if not 10 <= row < 14 else Landmarks(*(part[:0] for part in found)) for row, found in enumerate(landmarks)
    ]
    fit = fit_to_landmarks(
        [v[: len(found.depth)] for v, found in zip(values, few, strict=True)],
        few,
        np.arange(NUM_FRAMES),
        "up_to_scale",
        config(),
    )
    assert np.abs(errors(fit, values, landmarks)[inside]).max() < 0.02
    variance = fit.covariance[:, 0, 0]
    assert variance[11:13].min() > 1.5 * variance[5:9].max()
    with pytest.raises(ValueError, match="no frame has 12 landmarks .*at most 3"):
        fitted([v[:3] for v in values], [Landmarks(*(part[:3] for part in found)) for found in landmarks], "affine")


def test_the_uncertainty_of_a_scale_is_what_it_misses_the_truth_by():
    """Normalised squared errors of many sequences have mean one."""
    squares = []
    for seed in range(12):
        drift = np.cumsum(np.random.default_rng(100 + seed).normal(0, 0.01, NUM_FRAMES))
        values, landmarks = sequence("metric", drift, count=20, noise=0.05, seed=seed)
        # Its slope and its scale have one product; the true one is SLOPE e^s.
        fit = fitted(values, landmarks, "metric")
        missed = np.log(fit.base[0]) + fit.parameters[:, 0] - np.log(SLOPE) - drift
        squares.append(missed**2 / fit.covariance[:, 0, 0])
    assert 0.5 < np.mean(squares) < 2.0


@pytest.mark.parametrize(
    ("said", "kind", "message"),
    [("affine_inverse", "metric", "they are inverse depths"), ("up_to_scale", "affine_inverse", "they are depths")],
)
def test_a_wrong_kind_is_named_by_the_landmarks(said, kind, message):
    values, landmarks = sequence(said, np.zeros(4))
    with pytest.raises(ValueError, match=message):
        fitted([np.abs(v) + 0.01 if kind == "metric" else v for v in values], landmarks, kind)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="are they of these frames"):
        fitted([rng.permutation(np.abs(v) + 0.01) for v in values], landmarks, kind, min_correlation=0.4)


def test_what_would_lie_behind_the_camera_or_is_not_said_has_no_depth():
    values, landmarks = sequence("affine_inverse", np.zeros(6))
    fit = fitted(values, landmarks, "affine_inverse")
    depth, std = to_depth(np.array([[-1.0, np.nan, 0.3]]), fit, 0)
    np.testing.assert_array_equal(depth[0] > 0, [False, False, True])
    np.testing.assert_array_equal(np.isinf(std[0]), [True, True, False])


def test_the_smoother_is_the_solution_of_the_whole_linear_system():
    rng = np.random.default_rng(0)
    count, size = 7, 2
    roots = rng.normal(size=(count, size, size))
    information = roots @ roots.transpose(0, 2, 1)
    information[3] = 0.0  # a place that is not measured
    vector, step = rng.normal(size=(count, size)), rng.uniform(0.5, 3, (count - 1, size))
    vector[3] = 0.0
    whole = np.zeros((count * size,) * 2)
    for row in range(count):
        whole[2 * row : 2 * row + 2, 2 * row : 2 * row + 2] += information[row]
    for row in range(count - 1):
        link = np.diag(step[row])
        whole[2 * row : 2 * row + 4, 2 * row : 2 * row + 4] += np.block([[link, -link], [-link, link]])
    covariance = np.linalg.inv(whole)
    found, blocks, steps = smooth(information, vector, step)
    np.testing.assert_allclose(found.ravel(), covariance @ vector.ravel(), rtol=1e-9)
    for row in range(count):
        np.testing.assert_allclose(blocks[row], covariance[2 * row : 2 * row + 2, 2 * row : 2 * row + 2], rtol=1e-9)
    for row in range(count - 1):
        difference = np.zeros((size, count * size))
        difference[:, 2 * row : 2 * row + 4] = np.concatenate([-np.eye(2), np.eye(2)], axis=1)
        np.testing.assert_allclose(steps[row], np.diag(difference @ covariance @ difference.T), rtol=1e-9)
