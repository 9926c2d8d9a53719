"""View-dependent errors of classes: their share, that a view errs as one, and that other views err on their own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.prior.base import windows
from emgs_jax.prior.simulated.confusion import confused
from emgs_jax.prior.simulated.prior import Simulated

CLASSES = 40
EVERY = np.arange(-1, CLASSES).reshape(1, -1)


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
    window = next(windows(1, 1))
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
