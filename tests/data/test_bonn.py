"""Bonn RGB-D Dynamic; oracle: the authors' formula for a point of the sensor in the world."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.bonn import CALIBRATION, T_M, Bonn
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.reading import is_rigid
from emgs_jax.data.undistortion import undistortion

SEQUENCE = "rgbd_bonn_plane"
HALF_TURN = np.diag([-1.0, 1.0, 1.0, 1.0])[[0, 2, 1, 3]]  # x' = -x, y' = z, z' = y


def load(root, **options):
    (root / "rgbd_dataset_freiburg3_plane").rename(root / SEQUENCE)  # the layout is TUM's
    return Bonn(str(root), SEQUENCE, stride=1, **options)


def test_a_points_place_is_that_of_the_authors_formula_with_depths_in_their_unit(tum_root):
    path = tum_root / "rgbd_dataset_freiburg3_plane" / "groundtruth.txt"
    turns = Rotation.random(3, rng=np.random.default_rng(0))
    rows = [[100.0 + i, 1.0 + i, -0.5, 2.0, *turn.as_quat()] for i, turn in enumerate(turns)]
    np.savetxt(path, rows, fmt="%.9f")
    dataset = load(tum_root, intrinsics=CALIBRATION[0])
    assert dataset.has_ground_truth and dataset.classes == ()
    for row, turn in enumerate(turns):
        frame = dataset[row]
        markers = np.eye(4)
        markers[:3, :3], markers[:3, 3] = turn.as_matrix(), rows[row][1:4]
        raw = np.round(frame.depth * 4720.1) / 5000  # metres as the sensor has them
        points = backproject(raw, dataset.intrinsics).reshape(-1, 3)
        truth = np.linalg.inv(HALF_TURN) @ markers @ HALF_TURN @ T_M @ np.vstack([points.T, np.ones(len(points))])
        ours = frame.T_world_camera
        found = backproject(frame.depth, dataset.intrinsics).reshape(-1, 3) @ ours[:3, :3].T + ours[:3, 3]
        assert is_rigid(ours[None]) and np.linalg.det(ours[:3, :3]) == pytest.approx(1)
        assert np.abs(found - truth[:3].T).max() < 3e-4 * np.abs(raw).max(), "T_M is rounded to 1e-4"


def test_images_are_straightened_with_the_benchmarks_calibration_whatever_the_sequence_is_called(tum_root):
    dataset = load(tum_root)
    straight, *_ = undistortion(Calibration(*CALIBRATION), (640, 480))
    np.testing.assert_allclose(dataset.intrinsics[:2], np.array(straight[:2]) / 2)
    assert dataset.calibration["distortion"] == [*CALIBRATION[1]]
