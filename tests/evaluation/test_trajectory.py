"""Oracles: errors published with the trajectories, closed forms, invariances, evo where it is installed."""

from pathlib import Path

import numpy as np
import pytest
from hand_run import random_poses, random_similarity
from scipy.spatial.transform import Rotation

from emgs_jax.evaluation.trajectory import (
    DegenerateTrajectoryError,
    align,
    align_poses,
    associate,
    ate,
    check_conventions,
    rpe,
    trajectory_metrics,
)
from emgs_jax.geometry import Sim3
from emgs_jax.io.trajectory import load_trajectory_tum
from tests.data.written_scene import scalar_first

TRAJECTORIES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "trajectories"
needs_trajectories = pytest.mark.skipif(not TRAJECTORIES.exists(), reason="the shared trajectories are not here")
KNOWN = [  # estimate, reference, with scale, scale, pairs, RMSE: table in shared/data/README.md
    ("fr2_desk_ORB_kf_mono", "fr2_desk_groundtruth", True, 2.2280, 118, 0.00773),
    ("freiburg1_xyz-ORB_kf_mono", "freiburg1_xyz-groundtruth", True, 1.1056, 32, 0.00975),
    ("freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth", False, 1.0, 785, 0.01347),
]


def noisy(rng, poses, sigma):
    out = poses.copy()
    out[:, :3, 3] += sigma * rng.normal(size=(len(poses), 3))
    out[:, :3, :3] = out[:, :3, :3] @ Rotation.from_rotvec(sigma * rng.normal(size=(len(poses), 3))).as_matrix()
    return out


def scaled(poses, factor):
    return Sim3.about(np.zeros(3), factor).apply_to_poses(poses)


def assert_same_alignment(found, made, atol=1e-9):
    np.testing.assert_allclose(found.scale, made.scale, rtol=1e-9)
    np.testing.assert_allclose(found.rotation, made.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, made.translation, atol=10 * atol)


def associated(estimate, reference):
    times, poses = load_trajectory_tum(TRAJECTORIES / f"{estimate}.txt")
    true_times, truth = load_trajectory_tum(TRAJECTORIES / f"{reference}.txt")
    rows, true_rows = associate(times, true_times, 0.01)
    return poses[rows], truth[true_rows]


@needs_trajectories
@pytest.mark.parametrize(("estimate", "reference", "with_scale", "scale", "pairs", "rmse"), KNOWN)
def test_known_errors_of_public_trajectories_come_out_to_the_printed_digits(
    estimate, reference, with_scale, scale, pairs, rmse
):
    poses, truth = associated(estimate, reference)
    alignment = align(poses[:, :3, 3], truth[:, :3, 3], with_scale)
    assert len(poses) == pairs
    assert round(alignment.scale, 4) == scale
    assert round(ate(poses[:, :3, 3], truth[:, :3, 3], alignment), 5) == rmse


@needs_trajectories
@pytest.mark.parametrize(("estimate", "reference"), [row[:2] for row in KNOWN])
def test_all_errors_agree_with_evo(estimate, reference):
    pytest.importorskip("evo")
    from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
    from evo.core.trajectory import PosePath3D

    poses, truth = associated(estimate, reference)
    metrics = trajectory_metrics(poses, truth)
    for name, with_scale in (("ate_sim3_m", True), ("ate_se3_m", False)):
        path, true_path = PosePath3D(poses_se3=list(poses)), PosePath3D(poses_se3=list(truth))
        scale = path.align(true_path, correct_scale=with_scale)[2]
        if with_scale:
            np.testing.assert_allclose(metrics["trajectory/scale"], scale, rtol=1e-6)
        error = APE(PoseRelation.translation_part)
        error.process_data((true_path, path))
        np.testing.assert_allclose(metrics[f"trajectory/{name}"], error.get_statistic(StatisticsType.rmse), rtol=1e-6)
    relations = {"rpe_translation_m": "translation_part", "rpe_rotation_deg": "rotation_angle_deg"}
    for name, relation in relations.items():
        error = RPE(PoseRelation[relation], delta=1, delta_unit=Unit.frames)
        error.process_data((PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(poses))))
        np.testing.assert_allclose(metrics[f"trajectory/{name}"], error.get_statistic(StatisticsType.rmse), rtol=1e-6)


def test_align_finds_the_similarity_that_made_the_points_and_no_reflection():
    """The best orthogonal map of a mirrored path would be a reflection with no error at all."""
    rng = np.random.default_rng(0)
    made, points = random_similarity(rng, 2.5), rng.normal(size=(50, 3))
    assert_same_alignment(align(points, made.apply(points), with_scale=True), made, atol=1e-12)
    mirrored = points * np.array([1.0, 1.0, -1.0])
    found = align(points, mirrored, with_scale=False)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0, rtol=1e-12)
    assert ate(points, mirrored, found) > 0.5


def test_metrics_do_not_depend_on_the_frame_of_the_estimate_and_sim3_not_on_its_scale():
    rng = np.random.default_rng(3)
    truth = random_poses(rng, 25)
    estimate = noisy(rng, truth, 0.05)
    before = trajectory_metrics(estimate, truth)
    after = trajectory_metrics(random_poses(rng, 1)[0] @ estimate, truth)
    for key, value in before.items():
        np.testing.assert_allclose(after[key], value, rtol=1e-9, err_msg=key)
    after = trajectory_metrics(scaled(estimate, 4.0), truth)
    np.testing.assert_allclose(after["trajectory/ate_sim3_m"], before["trajectory/ate_sim3_m"], rtol=1e-9)
    np.testing.assert_allclose(after["trajectory/scale"], before["trajectory/scale"] / 4.0, rtol=1e-9)
    for factor in (2.0, 0.5):  # the percentage is the same for both
        metrics = trajectory_metrics(scaled(truth, factor), truth)
        np.testing.assert_allclose(metrics["trajectory/scale"], 1.0 / factor, rtol=1e-12)
        np.testing.assert_allclose(metrics["trajectory/scale_percent"], 50.0, rtol=1e-12)


def test_relative_errors_are_a_constant_drift_and_do_not_depend_on_the_frame_of_either_path():
    """Each step is 2 cm longer and turns 1 degree more; then paths that turn: on a straight one axes do not matter."""
    step, drift = np.eye(4), np.eye(4)
    step[:3, 3], drift[:3, 3] = [0.1, 0.0, 0.0], [0.02, 0.0, 0.0]
    drift[:3, :3] = Rotation.from_euler("z", 1.0, degrees=True).as_matrix()
    truth, estimate = (np.stack([np.linalg.matrix_power(T, i) for i in range(8)]) for T in (step, step @ drift))
    np.testing.assert_allclose(rpe(estimate, truth), (0.02, 1.0), rtol=1e-9)
    rng = np.random.default_rng(11)
    truth = random_poses(rng, 8)
    np.testing.assert_allclose(rpe(random_poses(rng, 1)[0] @ truth, truth), (0.0, 0.0), atol=1e-9)
    estimate = noisy(rng, truth, 0.1)
    expected = rpe(estimate, truth)
    np.testing.assert_allclose(rpe(estimate, random_poses(rng, 1)[0] @ truth), expected, rtol=1e-9)
    motions = [np.linalg.inv(a) @ b for path in (truth, estimate) for a, b in zip(path, path[1:], strict=False)]
    errors = [np.linalg.inv(true) @ found for true, found in zip(motions[:7], motions[7:], strict=True)]
    angles = [np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) for error in errors]
    np.testing.assert_allclose(expected[0] ** 2, np.mean([error[:3, 3] @ error[:3, 3] for error in errors]), rtol=1e-9)
    np.testing.assert_allclose(expected[1], np.sqrt(np.mean(np.square(angles))), rtol=1e-9)


def test_association_is_mutual_ordered_and_symmetric():
    times_a = np.array([0.0, 1.0, 1.004, 2.0, 5.0])
    times_b = np.array([1.003, 0.009, 2.02, 4.995])
    rows_a, rows_b = associate(times_a, times_b, 0.01)
    np.testing.assert_array_equal(rows_a, [0, 2, 4])
    np.testing.assert_array_equal(rows_b, [1, 0, 3])
    back_b, back_a = associate(times_b, times_a, 0.01)
    assert sorted(zip(back_a, back_b, strict=True)) == sorted(zip(rows_a, rows_b, strict=True))
    assert len(associate(times_a, np.empty(0), 1.0)[0]) == 0
    assert len(associate(np.array([3.0]), np.array([3.0]), 0.0)[0]) == 1


def test_too_few_poses_or_no_motion_give_null_with_a_reason():
    truth = random_poses(np.random.default_rng(5), 6)
    standing = truth.copy()
    standing[:, :3, 3] = 1.0
    for estimate, reference in ((truth[:2], truth[:2]), (truth[:0], truth[:0]), (standing, truth), (truth, standing)):
        metrics = trajectory_metrics(estimate, reference)
        assert metrics["trajectory/ate_sim3_m"] is None and metrics["trajectory/scale"] is None
        assert metrics["trajectory/reason"]
    # A stuck estimate still pays: without scale its error is the spread of the truth.
    spread = np.sqrt(np.mean(np.sum((truth[:, :3, 3] - truth[:, :3, 3].mean(0)) ** 2, axis=1)))
    np.testing.assert_allclose(trajectory_metrics(standing, truth)["trajectory/ate_se3_m"], spread, rtol=1e-9)
    broken = truth.copy()
    broken[3, 0, 3] = np.nan
    assert trajectory_metrics(broken, truth)["trajectory/reason"] == "a pose is not finite"
    with pytest.raises(DegenerateTrajectoryError):
        align(standing[:, :3, 3], truth[:, :3, 3], with_scale=True)
    with pytest.raises(ValueError, match="associate first"):
        trajectory_metrics(truth[:3], truth)


def straight_path(rng, n=12):
    poses = random_poses(rng, n)
    poses[:, :3, 3] = np.outer(np.linspace(0.0, 2.0, n), [0.6, 0.8, 0.0]) + 1.0
    return poses


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_on_a_straight_path_orientations_decide_the_roll_and_positions_the_scale(scale):
    rng = np.random.default_rng(6)
    truth, made = straight_path(rng), random_similarity(rng, scale)
    estimate = made.inverse().apply_to_poses(truth)
    found, note = align_poses(estimate, truth, with_scale=True)
    assert "straight path" in note
    assert_same_alignment(found, made, atol=1e-6)
    rigid, _ = align_poses(estimate, truth, with_scale=False)
    assert rigid.scale == 1.0
    np.testing.assert_allclose(rigid.rotation, made.rotation, atol=1e-6)
    # Orientations that are all off by 20 degrees, about an axis that is not the line, do not turn it.
    estimate = truth.copy()
    estimate[:, :3, :3] = Rotation.from_euler("z", 20.0, degrees=True).as_matrix() @ truth[:, :3, :3]
    found, _ = align_poses(estimate, truth, with_scale=True)
    np.testing.assert_allclose(found.apply(estimate[:, :3, 3]), truth[:, :3, 3], atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_on_a_path_that_is_straight_up_to_its_error_orientations_decide_the_roll(seed):
    """Four frames along an arc of 40 cm, .5 cm off: the map was scored upside down, 3 m away from the truth."""
    rng = np.random.default_rng(seed)
    truth, made = straight_path(rng, 4), random_similarity(rng, 1.3)
    truth[:, :3, 3] += 0.02 * rng.normal(size=(4, 3))
    found, note = align_poses(made.inverse().apply_to_poses(noisy(rng, truth, 0.02)), truth, with_scale=True)
    angle = np.degrees(Rotation.from_matrix(found.rotation @ made.rotation.T).magnitude())
    assert "straight path" in note and angle < 5
    wide = truth.copy()
    wide[2:, 2, 3] += 1.0
    assert align_poses(made.inverse().apply_to_poses(noisy(rng, wide, 0.02)), wide, with_scale=True)[1] is None


def test_without_motion_orientations_decide_the_rotation_and_the_size_stays():
    """One pose, two poses, and a camera that stands still in either of both paths."""
    rng = np.random.default_rng(9)
    truth, made = random_poses(rng, 6), random_similarity(rng, 1.0)
    standing = truth.copy()
    standing[:, :3, 3] = 1.0
    for rows, true in ((slice(0, 1), truth), (slice(None), standing)):
        found, note = align_poses(made.inverse().apply_to_poses(true[rows]), true[rows], with_scale=True)
        assert "without enough motion" in note
        assert_same_alignment(found, made)
    for estimate, reference, rows in ((truth, standing, 6), (standing, truth, 6), (truth, 2.0 * truth, 2)):
        found, note = align_poses(estimate[:rows], reference[:rows], with_scale=True)
        assert "without enough motion" in note and found.scale == 1.0


def test_pose_alignment_is_point_alignment_where_positions_suffice_and_aligned_poses_are_rigid():
    rng = np.random.default_rng(7)
    truth = random_poses(rng, 12)
    estimate = noisy(rng, truth, 0.1)
    found, note = align_poses(estimate, truth, with_scale=True)
    expected = align(estimate[:, :3, 3], truth[:, :3, 3], with_scale=True)
    assert note is None and found.scale == expected.scale
    np.testing.assert_array_equal(found.rotation, expected.rotation)
    made = random_similarity(rng, 3.0)
    moved = made.apply_to_poses(truth)
    np.testing.assert_allclose(moved[:, :3, 3], made.apply(truth[:, :3, 3]), rtol=1e-12)
    np.testing.assert_allclose(moved[:, :3, :3], made.rotation @ truth[:, :3, :3], atol=1e-12)
    np.testing.assert_array_equal(moved[:, 3], truth[:, 3])


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (np.linalg.inv, "world -> camera:"),
        (lambda pose: pose * [1, -1, -1, 1], "camera -> world of OpenGL's axes:"),
        (scalar_first, "with quaternions w, x, y, z:"),
    ],
)
def test_an_estimate_in_another_convention_is_named(written, words):
    """Quaternions w x y z left the ATE as it was and gave rotations of 10 degrees, without a word."""
    rng = np.random.default_rng(5)
    truth = random_poses(rng, 20)
    estimate = noisy(rng, truth, 0.02)
    check_conventions(estimate, truth, "path.txt")
    with pytest.raises(ValueError, match=f"path.txt: the motions .* taken as {words}"):
        check_conventions(np.stack([written(pose) for pose in estimate]), truth, "path.txt")
    check_conventions(random_poses(rng, 20), truth, "nothing that is known")
    check_conventions(estimate[:2], truth[:2], "two poses say little")


def test_a_gap_of_frames_is_no_step():
    """Symptom: five lost frames were one step, five times as long and as wrong as the others."""
    rng = np.random.default_rng(3)
    truth = random_poses(rng, 12)
    estimate = noisy(rng, truth, 0.01)
    estimate[8:] = np.array([[1, 0, 0, 3.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ estimate[8:]  # off by 3 m
    frames = np.r_[0:8, 13:17]
    parts = [rpe(estimate[part], truth[part]) for part in (slice(8), slice(8, None))]
    expected = [np.sqrt((7 * a**2 + 3 * b**2) / 10) for a, b in zip(*parts, strict=True)]
    np.testing.assert_allclose(rpe(estimate, truth, frames), expected, rtol=1e-9)
    assert rpe(estimate, truth)[0] > 5 * expected[0]
    found = trajectory_metrics(estimate, truth, frames)
    assert (found["trajectory/rpe_translation_m"], found["trajectory/rpe_rotation_deg"]) == pytest.approx(expected)
    apart = trajectory_metrics(estimate, truth, 2 * np.arange(12))
    assert apart["trajectory/rpe_translation_m"] is None and apart["trajectory/ate_sim3_m"] > 0
    with pytest.raises(DegenerateTrajectoryError, match="no two frames with a pose follow each other"):
        rpe(estimate, truth, 2 * np.arange(12))
