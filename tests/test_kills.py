"""The harness itself: it has to see a fault where there is one; the kills are made by `python -m tools.kills`."""

import json

import jax
import numpy as np
import pytest

from emgs_jax.gaussian_map import empty_map
from emgs_jax.io.map_file import save_map
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from tools.kills.folders import digest, faults, lost
from tools.kills.stops import Whole, _moment


@pytest.fixture
def folder(tmp_path):
    """Outputs as a run writes them."""
    points = np.random.default_rng(0).normal(size=(5, 3))
    save_points_ply(tmp_path / "points.ply", points, points / np.linalg.norm(points, axis=1, keepdims=True), points)
    save_trajectory_tum(tmp_path / "trajectory.txt", np.arange(3), np.stack([np.eye(4)] * 3))
    save_map(tmp_path / "map.npz", jax.tree.map(jax.numpy.asarray, empty_map(4, 0)))
    (tmp_path / "metrics.json").write_text(json.dumps({"map/num_gaussians": 3, "time/total_seconds": 1.0}))
    (tmp_path / "frames.jsonl").write_text('{"index": 0, "seconds": 1}\n{"index": 1, "seconds": 2}\n')
    return tmp_path


def test_sound_outputs_are_no_fault(folder):
    assert faults(folder, False) == [] and len(digest(folder)) == 5


@pytest.mark.parametrize("name", ["points.ply", "trajectory.txt", "map.npz", "metrics.json", "frames.jsonl"])
def test_a_file_that_is_half_written_is_a_fault(folder, name):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2 + 3])
    (fault,) = faults(folder, True)
    assert fault.startswith(f"{name} is not whole: ")


def test_temporary_files_are_a_fault_where_there_was_time_to_remove_them(folder):
    (folder / ".map.123.tmp.npz").write_bytes(b"1")
    assert faults(folder, True) == [] and faults(folder, False) == [".map.123.tmp.npz is left over"]


def test_times_are_no_difference_and_everything_else_is_one(folder):
    before = digest(folder)
    (folder / "metrics.json").write_text(json.dumps({"time/total_seconds": 9.0, "map/num_gaussians": 3}))
    (folder / "frames.jsonl").write_text('{"index": 0, "seconds": 7}\n{"index": 1, "seconds": 8}\n')
    assert digest(folder) == before
    (folder / "metrics.json").write_text(json.dumps({"time/total_seconds": 9.0, "map/num_gaussians": 4}))
    (folder / "frames.jsonl").write_text('{"index": 0, "seconds": 7}\n')
    (folder / "trajectory.txt").write_bytes((folder / "trajectory.txt").read_bytes() + b"#\n")
    after = digest(folder)
    assert {name for name in before if after[name] != before[name]} == {
        "metrics.json",
        "frames.jsonl",
        "trajectory.txt",
    }


def test_what_an_earlier_run_left_may_be_moved_but_not_changed(folder):
    earlier = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "previous-1").mkdir()
    (folder / "map.npz").rename(folder / "previous-1" / "map.npz")
    assert lost(folder, earlier) == []
    (folder / "previous-1" / "map.npz").write_bytes(b"other")
    (folder / "points.ply").unlink()
    assert sorted(lost(folder, earlier)) == ["map.npz", "points.ply"]


def test_runs_are_stopped_between_all_of_their_events_and_by_every_signal(tmp_path):
    whole = Whole(tmp_path, {}, [("start", 0.0), ("frames.jsonl 1", 4.0), ("map.npz", 5.0), ("end", 7.0)])
    moments = [_moment(whole, np.random.default_rng(seed)) for seed in range(200)]
    assert {name for name, _, _ in moments} == {"start", "frames.jsonl 1", "map.npz"}
    assert {sign.name for _, _, sign in moments} == {"SIGKILL", "SIGTERM", "SIGINT"}
    assert max(wait for name, wait, _ in moments if name == "frames.jsonl 1") <= 1.0
