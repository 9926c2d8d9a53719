"""The measure itself, on errors of a known law; rooms are mapped by `python -m tools.nees`."""

import numpy as np
import pytest
from hand_run import run_of
from scipy.spatial.transform import Rotation

from emgs_jax.mapping.records import FrameRecord
from tools.nees import errors_of_run, nees, pose_errors

COUNT = 4000


def draws() -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 6) with correlated parts, and their covariances."""
    rng = np.random.default_rng(0)
    factors = 0.01 * rng.normal(size=(COUNT, 6, 6))
    return (factors @ rng.normal(size=(COUNT, 6, 1)))[..., 0], factors @ factors.transpose(0, 2, 1)


def test_errors_of_the_law_that_is_said_give_one_and_half_the_deviation_four():
    errors, covariances = draws()
    assert nees(errors, covariances).mean() == pytest.approx(1.0, abs=0.05)
    assert nees(errors, covariances / 4).mean() == pytest.approx(4.0, abs=0.2)


def test_the_error_is_on_the_right_of_the_estimate():
    xi, T = np.array([0.01, -0.02, 0.03, 0.02, 0.01, -0.01]), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), [1.0, 2.0, 3.0]
    true = np.eye(4)
    true[:3, :3], true[:3, 3] = Rotation.from_rotvec(xi[3:]).as_matrix(), xi[:3]
    np.testing.assert_allclose(pose_errors(T[None], (T @ true)[None]), xi[None], atol=1e-12)


def test_a_run_is_compared_from_its_first_frame_on_and_by_its_tracked_frames():
    elsewhere, moved = np.eye(4), np.eye(4)
    elsewhere[:3, 3], moved[:3, 3] = [5.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    off = moved.copy()
    off[0, 3] = 0.02
    cov = 0.01**2 * np.eye(6)

    def record(status: str, pose: np.ndarray, true: np.ndarray, covariance: np.ndarray | None = cov) -> FrameRecord:
        return FrameRecord(0, None, None, status, pose=pose, true_pose=elsewhere @ true, covariance=covariance)

    records = [record("initialization", np.eye(4), np.eye(4), None), record("tracked", off, moved)]
    records += [record("degraded", 10 * off, moved), record("tracked", off, moved)]
    assert nees(*errors_of_run(run_of(records))) == pytest.approx([4.0 / 6.0] * 2)
