"""Depth, confidence and features of the simulated prior against docs/priors.md."""

import math
from dataclasses import replace

import numpy as np
import pytest

from emgs_jax.features.text import random_embeddings
from emgs_jax.prior.base import Window
from emgs_jax.prior.simulated.noise import edge_band
from emgs_jax.prior.simulated.prior import Simulated


def ask(prior, dataset, window):
    return prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)


@pytest.mark.parametrize("level", [0.5, 1.0])
def test_log_depth_error_is_the_sum_of_warps_and_pixel_noise_and_scales_with_level(make_room, level):
    room = make_room(size=(160, 120))
    flat = [replace(room[i], depth=np.full((120, 160), 2, np.float32)) for i in range(2)]
    log_errors = []
    for seed in range(40):
        prior = Simulated(level=level, seed=seed)
        prior.standard = replace(prior.standard, scale=0.0)
        depth = prior.predict(Window(0, (0, 1), (0, 1), 1), flat, room.intrinsics).points[..., 2]
        log_errors.append(np.log(depth / 2))
    log_errors = np.stack(log_errors)
    assert log_errors.std() == pytest.approx(level * math.sqrt(0.03**2 + 0.01**2 + 0.01**2), rel=0.08)
    # Neighbouring pixels differ by the pixel noise and very little of the warps (correlation lengths 16 and 4 px here).
    difference = np.diff(log_errors, axis=-1).std() / math.sqrt(2)
    warps = sum(s**2 * (1 - math.exp(-0.5 / ell**2)) for s, ell in [(0.03, 16), (0.01, 4)])
    assert difference == pytest.approx(level * math.sqrt(0.01**2 + warps), rel=0.03)


def log_errors(room, seeds, shape, inference=0, **standard):
    """Log-depth errors (seeds, h, w) of one flat frame of another size, without scale and flying points."""
    flat = [
        replace(frame, depth=np.full(shape, 2, np.float32), image=np.zeros((*shape, 3), np.uint8), labels=None)
        for frame in (room[0], room[1])
    ]
    found = []
    for seed in seeds:
        prior = Simulated(seed=seed)
        prior.standard = replace(prior.standard, scale=0.0, flying_share=0.0, **standard)
        window = Window(inference, (0, 1), (1,), 1)
        found.append(np.log(prior.predict(window, flat, room.intrinsics).points[0, ..., 2] / 2))
    return np.stack(found)


@pytest.mark.parametrize("shape", [(40, 160), (160, 40)])
def test_the_length_of_a_warp_follows_the_images_width(room, shape):
    """64 px of 640: a tenth of the width, across and down, whatever the height."""
    fields = log_errors(room, range(40), shape, warp=(0.03, 0.0), pixel=0.0)
    length = 0.1 * shape[1]
    for distance in (round(length / 2), round(length)):
        expected = math.exp(-0.5 * (distance / length) ** 2)
        across = np.mean(fields[:, :, distance:] * fields[:, :, :-distance])
        down = np.mean(fields[:, distance:] * fields[:, :-distance])
        np.testing.assert_allclose([across / 0.03**2, down / 0.03**2], expected, atol=0.13)


def test_70_percent_of_a_warps_variance_belong_to_the_image_and_pixel_noise_to_the_inference(room):
    """What an image does to a network it does every time; what is drawn anew is what fusing can average away."""
    for standard, sigma, shared in (
        ({"warp": (0.03, 0.0), "pixel": 0.0}, 0.03, 0.7),
        ({"warp": (0.0, 0.01), "pixel": 0.0}, 0.01, 0.7),
        ({"warp": (0.0, 0.0), "pixel": 0.02}, 0.02, 0.0),
    ):
        first, second = (log_errors(room, range(60), (40, 80), inference, **standard) for inference in (3, 4))
        np.testing.assert_allclose([first.std(), second.std()], sigma, rtol=0.1)
        np.testing.assert_allclose(np.mean(first * second) / sigma**2, shared, atol=0.1)


def test_the_two_warps_are_independent(room):
    """Of one length their variances add up; one stream for both would double the error."""
    total = log_errors(room, range(60), (40, 80), warp=(0.02, 0.02), warp_length=(64.0, 64.0), pixel=0.0)
    np.testing.assert_allclose(total.std(), 0.02 * math.sqrt(2), rtol=0.12)


def test_other_points_fly_in_the_next_inference(room):
    flying = []
    for inference in (3, 4):
        found = []
        for seed in range(40):
            prior = Simulated(seed=seed)
            prior.standard = replace(prior.standard, scale=0.0, warp=(0.0, 0.0), pixel=0.0)
            depth = ask(prior, room, Window(inference, (0, 1), (1,), 1)).points[0, ..., 2]
            found.append((depth != room[1].depth)[edge_band(room[1].depth, 0.05)])
        flying.append(np.stack(found))
    assert np.corrcoef(flying[0].ravel(), flying[1].ravel())[0, 1] == pytest.approx(0.0, abs=0.05)


def test_without_its_noise_the_confidence_is_the_stated_function_of_error_and_edge(room):
    """1 + 4 exp(-min(error / .03, 2) - 1.5 at an edge): a point that flies far is no worse than one that is .06 off."""
    prior = Simulated(seed=1)
    prior.standard = replace(prior.standard, scale=0.0, confidence_noise=0.0)
    prediction = ask(prior, room, Window(2, (0, 1), (1,), 1))
    depth, valid = room[1].depth, room[1].depth > 0
    error = np.abs(np.log(prediction.points[0, ..., 2][valid].astype(np.float64) / depth[valid]))
    near_edge = edge_band(depth, 0.05)[valid]
    expected = 1 + 4 * np.exp(-np.minimum(error / 0.03, 2.0) - 1.5 * near_edge)
    np.testing.assert_allclose(prediction.confidence[0][valid], expected, rtol=1e-4)
    assert (error > 0.1).sum() > 20 and (error < 0.02).sum() > 100


def test_points_stay_on_the_rays_of_their_pixels(room):
    fx, fy, cx, cy = room.intrinsics
    points = ask(Simulated(level=2), room, Window(1, (0, 1, 2), (1, 2), 2)).points[0]
    v, u = np.nonzero(points[..., 2])
    x, y, z = points[v, u].T
    np.testing.assert_allclose(fx * x / z + cx, u, atol=1e-4)
    np.testing.assert_allclose(fy * y / z + cy, v, atol=1e-4)


@pytest.mark.parametrize(("level", "share"), [(0, 0), (0.5, 0.25), (1, 0.5), (2, 0.5)])
def test_flying_points_are_near_steps_only_and_lie_between_the_two_sides(room, level, share):
    flying, band = [], None
    for seed in range(60):
        prior = Simulated(level=level, seed=seed)
        prior.standard = replace(prior.standard, scale=0.0, warp=(0.0, 0.0), pixel=0.0)
        depth = ask(prior, room, Window(0, (0, 1), (1,), 1)).points[0, ..., 2]
        band = edge_band(room[1].depth, 0.05)
        np.testing.assert_array_equal(depth[~band], room[1].depth[~band])
        assert (depth[band] >= 2).all() and (depth[band] <= 3).all()
        flying.append(depth != room[1].depth)
    assert np.mean(np.stack(flying)[:, band]) == pytest.approx(share, abs=0.02)


def test_missing_depth_is_masked_with_zero_points_and_finite_values_everywhere(room):
    frame = room[1]
    frame.depth[20, 20:24] = np.nan, np.inf, -np.inf, -1
    prediction = Simulated().predict(Window(0, (0, 1), (1,), 1), [room[0], frame], room.intrinsics)
    valid = np.isfinite(frame.depth) & (frame.depth > 0)
    assert (~valid).sum() == 19
    np.testing.assert_array_equal(prediction.mask[0], valid)
    assert not prediction.points[0][~valid].any()
    assert np.isfinite(prediction.points).all() and np.isfinite(prediction.confidence).all()


def test_confidence_is_at_least_1_and_lower_at_edges_and_where_the_error_is_larger(make_room):
    room = make_room(size=(160, 120))
    confidence, error = [], []
    for seed in range(5):
        prior = Simulated(seed=seed)
        prior.standard = replace(prior.standard, scale=0.0)
        prediction = ask(prior, room, Window(0, (0, 1), (1,), 1))
        confidence.append(prediction.confidence[0])
        error.append(np.abs(np.log(np.maximum(prediction.points[0, ..., 2], 1e-9) / np.maximum(room[1].depth, 1e-9))))
    confidence, error = np.stack(confidence), np.stack(error)
    band, valid = edge_band(room[1].depth, 0.05), room[1].depth > 0
    assert confidence.min() >= 1
    away = valid & ~band
    assert -0.95 < np.corrcoef(np.log(confidence[:, away]).ravel(), error[:, away].ravel())[0, 1] < -0.5
    assert np.median(confidence[:, band]) < 0.7 * np.median(confidence[:, away])


def test_features_are_unit_and_have_cosine_08_with_their_own_class(make_room):
    room = make_room(size=(160, 120))
    prior = Simulated(feature_size=16, classes=room.classes)
    prediction = ask(prior, room, Window(0, (0, 1), (0, 1), 1))
    features, labels = prediction.features[1].astype(np.float64), room[1].labels
    np.testing.assert_allclose(np.linalg.norm(features[labels >= 0], axis=-1), 1, atol=2e-3)  # float16
    assert not features[labels < 0].any()
    for label in (0, 1):
        assert np.mean(features[labels == label] @ prior.text_features[label]) == pytest.approx(0.8, abs=0.03)


def test_text_embeddings_are_unit_depend_on_the_name_only_and_are_nearly_orthogonal():
    names = [f"class {i}" for i in range(50)]
    embeddings = random_embeddings(names, 256)
    np.testing.assert_allclose(np.linalg.norm(embeddings, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(random_embeddings(names[::-1], 256), embeddings[::-1])
    assert np.abs(embeddings @ embeddings.T - np.eye(50)).max() < 5 / math.sqrt(256)


def test_without_classes_or_labels_there_are_no_features(room):
    window = Window(0, (0, 1), (0, 1), 1)
    assert ask(Simulated(), room, window).features.shape == (2, 30, 40, 0)
    unlabelled = [replace(room[i], labels=None) for i in (0, 1)]
    features = Simulated(feature_size=4, classes=room.classes).predict(window, unlabelled, room.intrinsics).features
    assert features.shape == (2, 30, 40, 4) and not features.any()
