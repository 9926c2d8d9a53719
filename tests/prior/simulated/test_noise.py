"""The seeded numbers and fields against their stated statistics; tolerances are about four standard errors."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.prior.base import windows
from emgs_jax.prior.simulated.noise import Stream, autoregressive, confused, edge_band, smooth_field
from emgs_jax.prior.simulated.prior import Simulated

CLASSES = 40
EVERY = np.arange(-1, CLASSES).reshape(1, -1)


def test_another_process_gives_the_same_bits():
    program = (
        "from emgs_jax.prior.simulated.noise import *; "
        "field, walk = smooth_field((24, 32), 3.2, (1, 7, 2, 5), .7), autoregressive(1, 50, .9, 7); "
        "print((field.tobytes() + walk.tobytes()).hex())"
    )
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    here = smooth_field((24, 32), 3.2, (1, 7, 2, 5), 0.7).tobytes() + autoregressive(1, 50, 0.9, 7).tobytes()
    assert told.stdout.strip() == here.hex()


def test_smooth_field_has_unit_variance_everywhere_and_the_stated_correlation_length():
    length, shape = 8.0, (48, 64)
    fields = np.stack([smooth_field(shape, length, (0, Stream.WARP, 1, i), 0.7) for i in range(1500)])
    assert fields.dtype == np.float32
    deviation = fields.std(axis=0)
    assert deviation.min() > 0.92 and deviation.max() < 1.08  # of each pixel, borders included
    for distance in (4, 8, 16):
        expected = math.exp(-0.5 * (distance / length) ** 2)
        for a, b in [
            (fields[:, :, distance:], fields[:, :, :-distance]),
            (fields[:, distance:], fields[:, :-distance]),
        ]:
            assert np.mean(a * b) == pytest.approx(expected, abs=0.03)
    assert np.mean(fields[:, :-32, :-32] * fields[:, 32:, 32:]) == pytest.approx(0, abs=0.03)


def test_edge_band_is_two_pixels_on_each_side_of_a_step_of_more_than_5_percent():
    depth = np.full((7, 12), 2.0, np.float32)
    depth[:, 6:] = 2.2
    expected = np.zeros((7, 12), bool)
    expected[:, 4:8] = True
    np.testing.assert_array_equal(edge_band(depth, 0.05), expected)
    depth[:, 6:] = 2.09
    assert not edge_band(depth, 0.05).any()
    depth[:, 6:] = 0  # the border of missing depth is no step
    assert not edge_band(depth, 0.05).any()


def pose_at(place, yaw=0.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    pose[:3, 3] = place
    return pose


def test_the_share_of_classes_that_err_is_the_one_asked_for_and_no_class_stays_none():
    views = [pose_at((4.0 * x, 0, 4.0 * z)) for x in range(-5, 5) for z in range(-5, 5)]
    seen = np.stack([confused(EVERY, view, CLASSES, 0.3, 0) for view in views])
    assert (seen[..., 0] == -1).all() and seen.min() == -1 and seen.max() == CLASSES - 1
    wrong = (seen != EVERY)[..., 1:].mean()
    assert wrong == pytest.approx(0.3 * (1 - 1 / CLASSES), abs=0.02)  # 4,000 draws; a class may be taken for itself


def test_a_view_errs_as_one_and_another_place_or_direction_errs_otherwise():
    here = confused(EVERY, pose_at((0.1, 0.2, 0.3)), CLASSES, 0.5, 3)
    np.testing.assert_array_equal(confused(EVERY, pose_at((0.4, -0.2, 0.1), yaw=3.0), CLASSES, 0.5, 3), here)
    image = np.random.default_rng(0).integers(-1, CLASSES, (5, 7), np.int32)
    np.testing.assert_array_equal(confused(image, pose_at((0, 0, 0)), CLASSES, 0.5, 3), here[0][image + 1])
    for other in (pose_at((4.0, 0, 0)), pose_at((0, 0, 0), yaw=90.0)):
        assert (confused(EVERY, other, CLASSES, 0.5, 3) != here).mean() > 0.3
    assert (confused(EVERY, pose_at((0, 0, 0)), CLASSES, 0.5, 4) != here).any()
    assert confused(EVERY, pose_at((0, 0, 0)), CLASSES, 0.0, 3) is EVERY


def test_features_are_of_the_classes_that_others_are_taken_for_as_far_as_the_level_says(room):
    window = next(windows(range(1).__contains__, 1))
    frame, names = room[0], tuple(map(str, range(CLASSES)))
    exact = Simulated(level=1e-9, classes=names).predict(window, [frame], room.intrinsics).features[0]
    prior = Simulated(level=1e-9, classes=names, confusion=1.0)
    np.testing.assert_array_equal(prior.predict(window, [frame], room.intrinsics).features[0], exact)
    prior = Simulated(level=1.0, classes=names, confusion=1.0)
    features = prior.predict(window, [frame], room.intrinsics).features[0].astype(np.float32)
    found = (features @ prior.text_features.T).argmax(-1)
    expected = confused(frame.labels, frame.T_world_camera, CLASSES, 1.0, 0)
    known = expected >= 0
    assert (found == expected)[known].mean() > 0.9 and (found == frame.labels)[known].mean() < 0.5
    assert prior.provenance.settings["confusion"] == 1.0 and "confusion" not in Simulated().provenance.settings
