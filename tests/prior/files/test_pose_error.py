"""How far off poses are, as the images say: against disturbances that are drawn."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.config.configure import build_dataset, compose
from emgs_jax.prior.files import pose_error
from emgs_jax.prior.files.pose_error import calibration, pair_error, pose_angle, sampson
from emgs_jax.prior.files.prior import Files, _stored_words

pytestmark = pytest.mark.slow


@cache
def room():
    """Frames of the built-in room, each drawn once."""
    dataset = build_dataset(compose())
    return SimpleNamespace(frames=[dataset[row] for row in range(len(dataset))], intrinsics=dataset.intrinsics)


class Frames:
    """The frames of the room as a data set."""

    intrinsics = property(lambda self: room().intrinsics)

    def __getitem__(self, index: int):
        return room().frames[index]


def poses(std_rad: float, walk: bool = False, seed: int = 0) -> dict[int, np.ndarray]:
    """True poses with errors per axis, of rotations and of positions over the depth: drawn anew, or summed up."""
    rng, frames = np.random.default_rng(seed), room().frames
    errors = std_rad * rng.normal(size=(len(frames), 6))
    errors = np.cumsum(errors, axis=0) if walk else errors
    found = {}
    for frame, (*turn, x, y, z) in zip(frames, errors, strict=True):
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        error[:3, 3] = np.median(frame.depth[frame.depth > 0]) * np.array([x, y, z])
        found[frame.index] = frame.T_world_camera @ error
    return found


@pytest.fixture(autouse=True)
def detect_once(monkeypatch):
    monkeypatch.setattr(pose_error, "detect", _detect)


@cache
def _found(image: bytes, shape: tuple[int, ...], *settings):
    return DETECT(np.frombuffer(image, np.uint8).reshape(shape), *settings)


def _detect(image, *settings):
    return _found(image.tobytes(), image.shape, *settings)


DETECT = pose_error.detect


def test_a_point_that_both_rays_meet_has_no_error_and_one_beside_has_its_distance():
    K, E = calibration((100.0, 100.0, 50.0, 40.0)), np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # along x
    a = np.array([[20.0, 30.0], [70.0, 44.0]])
    np.testing.assert_allclose(sampson(E, a, a + [5.0, 0.0], K), 0, atol=1e-12)
    # Half of it in each image.
    np.testing.assert_allclose(np.abs(sampson(E, a, a + [5.0, 2.0], K)), 2 / np.sqrt(2), rtol=1e-12)


@pytest.mark.parametrize("std", [0.002, 0.01])
def test_the_angle_is_that_of_the_errors_that_were_drawn(std):
    found = [pose_angle(Frames(), poses(std, seed=seed)) for seed in range(4)]
    # The median of six pairs, of which each has one error of its two poses.
    assert np.mean(found) == pytest.approx(std, rel=0.35)


def test_true_poses_are_sure_and_a_drift_is_found_out_by_frames_that_are_far_apart(monkeypatch):
    exact, drifting = (pose_angle(Frames(), poses(std, walk=True)) for std in (0.0, 0.001))
    assert exact < 1e-4 < drifting / 2
    monkeypatch.setattr(pose_error, "GAPS", (1,))
    assert pose_angle(Frames(), poses(0.001, walk=True)) < 0.7 * drifting


def test_images_without_points_and_a_camera_that_rests_say_nothing():
    image = room().frames[0].image
    blank = np.full_like(image, 90)
    moved = np.eye(4)
    moved[0, 3] = 0.1
    assert pair_error([blank, blank], moved, room().intrinsics) is None
    assert pair_error([image, image], np.eye(4), room().intrinsics) is None
    assert pose_angle(Frames(), {0: np.eye(4)}) is None


@pytest.mark.parametrize(("orientation", "turn"), [(3, 180), (6, 90), (8, -90)])
def test_poses_of_images_as_they_are_stored_are_told_from_those_as_they_are_shown(orientation, turn):
    """Turned by 180 degrees all sides fit, and each pixel got the depth of the one across the middle."""
    stored = np.eye(4)
    stored[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix().round()
    shown, turned = poses(1e-3), {orientation: Path("a.jpg")}
    of_stored = {index: pose @ stored for index, pose in shown.items()}
    words = _stored_words(Frames(), of_stored, turned, pose_angle(Frames(), of_stored))
    assert "a.jpg is shown turned by its EXIF orientation" in words
    assert _stored_words(Frames(), shown, turned, pose_angle(Frames(), shown)) is None


def test_files_in_another_order_than_the_images_fit_each_other_and_are_said_not_to_fit_those(tmp_path, capsys):
    """Each image had the depth and pose of another: depths of two views agreed, and nothing was said."""
    dataset = build_dataset(compose("dataset.stop=12"))
    for name, order in (("right", range(12)), ("reversed", range(11, -1, -1))):
        (tmp_path / name).mkdir()
        for row, other in enumerate(order):
            frame = room().frames[other]
            given = {"depth": frame.depth, "T_world_camera": frame.T_world_camera}
            np.savez(tmp_path / name / f"{row:06d}.npz", **given)
        keys = {"scale": "auto", "median_depth": 2.0, "depth_scale": 1000.0, "max_depth_step": 0.03}
        Files(tmp_path / name, **keys).check(dataset, 4)
        said = capsys.readouterr().out
        assert ("check which file is of which image" in said) == (name == "reversed")
