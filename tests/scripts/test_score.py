"""A peer under our protocol; oracles: the truth itself, a known similarity of it, evo's association, bad files."""

import json
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_run import NUM_FRAMES, compose, dataset

from emgs_jax.evaluation.reconstruction import ground_truth_cloud
from emgs_jax.geometry import Sim3
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.report.tables import average, full_table
from emgs_jax.runs.results import read_estimates
from experiments.score import coverage, score, unit_note

pytestmark = pytest.mark.slow

SIMILARITY = Sim3(0.4, Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix(), np.array([3.0, -1.0, 7.0]))


@cache
def room():
    """True times, poses and cloud of the tiny room."""
    from scene import evaluation_config

    frames = list(dataset())
    cloud = ground_truth_cloud(frames, dataset().intrinsics, evaluation_config())
    return np.array([frame.timestamp for frame in frames]), np.stack([f.T_world_camera for f in frames]), cloud


truth = pytest.fixture(scope="module")(lambda: room())


def write_system(folder, times, poses, cloud, move=SIMILARITY, normals=None):
    """Files of another system whose world differs by `move`."""
    save_trajectory_tum(folder / "path.txt", times, move.apply_to_poses(poses))
    normals = cloud.normals @ move.rotation.T if normals is None else normals
    save_points_ply(folder / "cloud.ply", move.apply(cloud.points), normals, cloud.colors)
    return f"trajectory={folder / 'path.txt'}", f"points={folder / 'cloud.ply'}", f"out={folder / 'out'}"


def scored(*overrides):
    return score(compose("method=peer", *overrides, name="score"))


def test_the_truth_in_another_frame_and_scale_is_perfect_under_sim3(tmp_path, truth):
    metrics, path = scored(*write_system(tmp_path, *truth))
    assert metrics["trajectory/ate_sim3_m"] < 1e-6
    np.testing.assert_allclose(metrics["trajectory/scale"], 2.5, rtol=1e-6)
    assert metrics["reconstruction/accuracy_m"] < 1e-3  # float32 may move a point across the border of its voxel
    assert metrics["reconstruction/f1_5cm_percent"] > 99.9
    assert metrics["reconstruction/normals_abs_cos_percent"] > 99.9
    assert json.loads(path.read_text())["provenance"]["protocol"] == "paper/sim3"
    assert path.parent.relative_to(tmp_path / "out").as_posix() == "synthetic/room0/peer/0"


def test_without_scale_the_error_of_the_scale_is_seen(tmp_path, truth):
    metrics, _ = scored(*write_system(tmp_path, *truth), "evaluation.alignment=se3")
    assert metrics["trajectory/ate_sim3_m"] < 1e-6 < 0.01 < metrics["trajectory/ate_se3_m"]
    assert metrics["reconstruction/accuracy_m"] > 0.1


@pytest.mark.parametrize(
    ("scale", "words"), [(1.02e-3, "in millimetres"), (0.0099, "in centimetres"), (980.0, "in kilometres"), (0.4, "")]
)
def test_a_path_in_another_unit_is_said_where_metres_are_scored(scale, words):
    note = unit_note({"trajectory/scale": scale}, "se3")
    assert words in note and bool(words) == note.startswith("warning: the path is")
    assert unit_note({"trajectory/scale": scale}, "sim3") == "" == unit_note({"trajectory/scale": None}, "se3")


def test_the_table_of_an_evaluation_shows_the_other_system_under_its_name(tmp_path, truth):
    scored(*write_system(tmp_path, *truth), "simulated=true")
    (row,) = average(read_estimates(tmp_path / "out"), each_sequence=True)
    assert (row.dataset, row.sequences, row.kind, row.variant) == ("synthetic", ("room0",), "scored", "peer")
    assert "| scored, peer | **simulated** |" in full_table([row])


def test_keyframes_are_matched_by_time_and_a_trajectory_alone_is_enough(tmp_path, truth):
    times, poses, cloud = truth
    rows = [4, 0, 2, 3]
    times = np.append(times[rows] + 0.009, 77.0)
    poses = np.concatenate([poses[rows], poses[:1]])
    trajectory, _, out = write_system(tmp_path, times, poses, cloud)
    metrics, _ = scored(trajectory, out)
    assert metrics["trajectory/num_frames"] == 4 and metrics["trajectory/ate_sim3_m"] < 1e-6
    assert (metrics["score/num_poses"], metrics["score/num_frames"]) == (5, NUM_FRAMES)
    assert coverage(metrics, 90).startswith("4 of 5 poses are associated with true poses, which is 67 % of the 6 ")
    assert not any(key.startswith("reconstruction") for key in metrics)


def test_lines_in_any_order_have_the_errors_of_those_in_order_of_time(tmp_path, truth):
    """The motion from each line to the next was compared: an RPE of .70 cm became 5.29."""
    times, poses, cloud = truth
    moved = poses.copy()
    moved[:, :3, 3] += np.random.default_rng(0).normal(0, 0.01, (len(poses), 3))
    found = []
    for rows in (np.arange(len(times)), [3, 0, 5, 1, 4, 2]):
        (tmp_path / str(len(found))).mkdir()
        trajectory, _, out = write_system(tmp_path / str(len(found)), times[rows], moved[rows], cloud)
        found.append(scored(trajectory, out)[0]["trajectory/rpe_translation_m"])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)


def test_a_motion_over_frames_without_a_pose_does_not_count(tmp_path, truth):
    """As in metrics.json of a run: a gap is no step."""
    times, poses, cloud = truth
    rows, found = [0, 1, 3, 4, 5], []
    for jump in (0.0, 5.0):
        moved = poses.copy()
        moved[3:, 0, 3] += jump
        (tmp_path / str(jump)).mkdir()
        trajectory, _, out = write_system(tmp_path / str(jump), times[rows], moved[rows], cloud)
        found.append(scored(trajectory, out)[0]["trajectory/rpe_translation_m"])
    assert found[1] == pytest.approx(found[0], rel=1e-6)


@pytest.mark.parametrize(("matched", "warns"), [(18, False), (17, True)])
def test_a_system_that_knows_less_than_the_wanted_share_of_the_frames_is_warned_of(matched, warns):
    text = coverage({"trajectory/num_frames": matched, "score/num_poses": 40, "score/num_frames": 20}, 90)
    assert text.startswith(f"{matched} of 40 poses are associated with true poses, which is {5 * matched} % of the 20")
    assert ("warning" in text and "dataset.start" in text) == warns


def test_normals_of_a_cloud_without_any_are_fitted(tmp_path, truth):
    """Open3D takes zero normals as normals, so the file must not have them: points alone, as text."""
    trajectory, points, out = write_system(tmp_path, *truth)
    moved = SIMILARITY.apply(truth[2].points)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(moved)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    lines = "\n".join(" ".join(map(repr, map(float, row))) for row in moved)
    (tmp_path / "cloud.ply").write_text(header + lines + "\n")
    metrics, _ = scored(trajectory, points, out)
    assert metrics["reconstruction/accuracy_m"] < 1e-3
    assert metrics["reconstruction/normals_abs_cos_percent"] > 80.0


def test_another_result_is_never_replaced_but_the_same_one_may_be_made_again(tmp_path, truth):
    files = write_system(tmp_path, *truth)
    first, path = scored(*files)
    assert scored(*files)[0]["trajectory/ate_sim3_m"] == first["trajectory/ate_sim3_m"]
    before = path.read_bytes()
    with pytest.raises(ValueError, match="made with other settings .*method=NAME"):
        scored(*files, "evaluation.alignment=se3")
    assert path.read_bytes() == before
