"""Depth, confidence and features of the simulated prior against docs/simulated.md."""

import math
from dataclasses import replace

import numpy as np
import pytest
from draws import NO_WARP, ask, prior_with

from emgs_jax.features.text import random_embeddings
from emgs_jax.prior.base import Window
from emgs_jax.prior.simulated.noise import edge_band
from emgs_jax.prior.simulated.prior import Simulated

WINDOW = Window(0, (0, 1), (1,), 1)
ONLY_FLYING = NO_WARP | {"scale": 0.0, "pixel": 0.0}


def log_errors(room, seeds, shape, inference=0, level=1.0, **standard):
    """Log-depth errors (seeds, h, w) of one flat frame of another size, without scale and flying points."""
    change = {"depth": np.full(shape, 2, np.float32), "image": np.zeros((*shape, 3), np.uint8), "labels": None}
    flat, found = [replace(room[index], **change) for index in (0, 1)], []
    for seed in seeds:
        prior = prior_with({"scale": 0.0, "flying_share": 0.0} | standard, seed=seed, level=level)
        points = prior.predict(replace(WINDOW, inference=inference), flat, room.intrinsics).points
        found.append(np.log(points[0, ..., 2] / 2))
    return np.stack(found)


@pytest.mark.parametrize("level", [0.5, 1.0])
def test_log_depth_error_is_the_sum_of_warps_and_pixel_noise_and_scales_with_level(room, level):
    found = log_errors(room, range(60), (120, 160), level=level)
    assert found.std() == pytest.approx(level * math.sqrt(0.03**2 + 0.01**2 + 0.01**2), rel=0.08)
    # Neighbouring pixels differ by the pixel noise and very little of the warps (correlation lengths 16 and 4 px here).
    difference = np.diff(found, axis=-1).std() / math.sqrt(2)
    warps = sum(s**2 * (1 - math.exp(-0.5 / ell**2)) for s, ell in [(0.03, 16), (0.01, 4)])
    assert difference == pytest.approx(level * math.sqrt(0.01**2 + warps), rel=0.03)


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
        (NO_WARP | {"pixel": 0.02}, 0.02, 0.0),
    ):
        first, second = (log_errors(room, range(60), (40, 80), inference, **standard) for inference in (3, 4))
        np.testing.assert_allclose([first.std(), second.std()], sigma, rtol=0.1)
        np.testing.assert_allclose(np.mean(first * second) / sigma**2, shared, atol=0.1)
    # Of one length the variances of the two warps add up; one stream for both would double the error.
    total = log_errors(room, range(60), (40, 80), warp=(0.02, 0.02), warp_length=(64.0, 64.0), pixel=0.0)
    np.testing.assert_allclose(total.std(), 0.02 * math.sqrt(2), rtol=0.12)


@pytest.mark.parametrize(("level", "share"), [(0, 0), (0.5, 0.25), (1, 0.5), (2, 0.5)])
def test_flying_points_are_near_steps_only_between_the_two_sides_and_others_in_the_next_inference(room, level, share):
    flying, band = ([], []), edge_band(room[1].depth, 0.05)
    for seed in range(60):
        prior = prior_with(ONLY_FLYING, level=level, seed=seed)
        for inference, found in enumerate(flying):
            depth = ask(prior, room, replace(WINDOW, inference=inference)).points[0, ..., 2]
            np.testing.assert_array_equal(depth[~band], room[1].depth[~band])
            assert (depth[band] >= 2).all() and (depth[band] <= 3).all()
            found.append((depth != room[1].depth)[band])
    assert np.mean(flying) == pytest.approx(share, abs=0.02)
    if share:
        assert np.corrcoef(np.ravel(flying[0]), np.ravel(flying[1]))[0, 1] == pytest.approx(0.0, abs=0.05)


def test_without_its_noise_the_confidence_is_the_stated_function_of_error_and_edge(room):
    """1 + 4 exp(-min(error / .03, 2) - 1.5 at an edge): a point that flies far is no worse than one that is .06 off."""
    prediction = ask(prior_with({"scale": 0.0, "confidence_noise": 0.0}, seed=1), room, replace(WINDOW, inference=2))
    depth, valid = room[1].depth, room[1].depth > 0
    error = np.abs(np.log(prediction.points[0, ..., 2][valid].astype(np.float64) / depth[valid]))
    expected = 1 + 4 * np.exp(-np.minimum(error / 0.03, 2.0) - 1.5 * edge_band(depth, 0.05)[valid])
    np.testing.assert_allclose(prediction.confidence[0][valid], expected, rtol=1e-4)
    assert (error > 0.1).sum() > 20 and (error < 0.02).sum() > 100


def test_points_stay_on_rays_and_missing_depth_is_masked_with_zero_points_and_finite_values_everywhere(room):
    fx, fy, cx, cy = room.intrinsics
    frame = room[1]
    frame.depth[20, 20:24] = np.nan, np.inf, -np.inf, -1
    prediction = Simulated(level=2).predict(WINDOW, [room[0], frame], room.intrinsics)
    valid = np.isfinite(frame.depth) & (frame.depth > 0)
    assert (~valid).sum() == 19
    np.testing.assert_array_equal(prediction.mask[0], valid)
    assert not prediction.points[0][~valid].any()
    assert np.isfinite(prediction.points).all() and np.isfinite(prediction.confidence).all()
    v, u = np.nonzero(valid)
    x, y, z = prediction.points[0][v, u].T
    np.testing.assert_allclose(fx * x / z + cx, u, atol=1e-4)
    np.testing.assert_allclose(fy * y / z + cy, v, atol=1e-4)


def test_confidence_is_at_least_1_and_hides_a_part_of_the_error(make_room):
    room = make_room(size=(160, 120))
    predictions = [ask(prior_with({"scale": 0.0}, seed=seed), room, WINDOW) for seed in range(5)]
    confidence = np.stack([prediction.confidence[0] for prediction in predictions])
    band, valid = edge_band(room[1].depth, 0.05), room[1].depth > 0
    away = valid & ~band
    error = np.stack([np.abs(np.log(one.points[0, ..., 2][away] / room[1].depth[away])) for one in predictions])
    assert confidence.min() >= 1
    assert -0.95 < np.corrcoef(np.log(confidence[:, away]).ravel(), error.ravel())[0, 1] < -0.5
    assert np.median(confidence[:, band]) < 0.7 * np.median(confidence[:, away])


def test_features_are_unit_and_have_cosine_08_with_their_own_class(make_room):
    room = make_room(size=(160, 120))
    prior = Simulated(feature_size=16, classes=room.classes)
    features, labels = ask(prior, room, WINDOW).features[0].astype(np.float64), room[1].labels
    np.testing.assert_allclose(np.linalg.norm(features[labels >= 0], axis=-1), 1, atol=2e-3)  # float16
    assert not features[labels < 0].any()
    for label in (0, 1):
        assert np.mean(features[labels == label] @ prior.text_features[label]) == pytest.approx(0.8, abs=0.03)
    assert ask(Simulated(), room, WINDOW).features.shape == (1, 120, 160, 0)
    unlabelled = prior.predict(WINDOW, [replace(room[i], labels=None) for i in (0, 1)], room.intrinsics).features
    assert unlabelled.shape == (1, 120, 160, 16) and not unlabelled.any()


def test_text_embeddings_are_unit_depend_on_the_name_only_and_are_nearly_orthogonal():
    names = [f"class {i}" for i in range(50)]
    embeddings = random_embeddings(names, 256)
    np.testing.assert_allclose(np.linalg.norm(embeddings, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(random_embeddings(names[::-1], 256), embeddings[::-1])
    assert np.abs(embeddings @ embeddings.T - np.eye(50)).max() < 5 / math.sqrt(256)
