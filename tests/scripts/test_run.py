"""The script: files, metrics, interruption, bad input; oracle: the truth, reloading, and a second process."""

import json
import re
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import hydra
import numpy as np
import pytest
from omegaconf import OmegaConf
from tiny_run import NUM_FRAMES, TINY, WINDOW_SIZE, EditedPrior, compose, dataset

import experiments.run
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.device.clock import Clock
from emgs_jax.gaussian_map import confirmed
from emgs_jax.io.map_file import load_map
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.runs.provenance import RESULT_FORMAT, is_in_metres
from experiments.command import clear_errors

pytestmark = pytest.mark.xdist_group("tiny")

FILES = {"trajectory.txt", "map.npz", "map.ply", "points.ply", "mesh.ply", "frames.jsonl", "overview.png", "text.npz"}
FILES |= {"report.html"}
ERRORS = [f"{kind}_{size}cm_percent" for size in (20, 5) for kind in ("f1", "precision", "recall")]
NORMALS = ["normals_abs_cos_percent", "normals_within_30deg_percent"]
TRAJECTORY = ["ate_sim3_m", "ate_se3_m", "scale", "scale_percent", "num_frames", "placed_percent"]
TRAJECTORY += ["rpe_translation_m", "rpe_rotation_deg"]
RECONSTRUCTION = ["accuracy_m", "completion_m", *ERRORS, *NORMALS, "num_points", "alignment_note"]
RENDERING = ["coverage_percent", "worst_coverage_percent", "depth_l1_m", "depth_within_5_percent", "psnr_db"]
RENDERING += ["num_frames", "label_accuracy_percent", "label_miou_percent"]
SEGMENTATION = ["miou_percent", "fmiou_percent", "mean_recall_percent", "accuracy_percent", "num_points"]
COMPARED = [f"trajectory/{name}" for name in TRAJECTORY] + [f"reconstruction/{name}" for name in RECONSTRUCTION]
PHASES = ("setup", "load", "predict", "map", "raw_prior", "densify", "export", "evaluate", "compile", "total")
PHASE_WORDS = (
    "drawing the map from the pose of every frame",
    "writing the map, its points, a mesh and the overview",
    "comparing with the truth: the map, the raw prior",
    "writing report.html",
)
COMPARED += [f"reconstruction_icp/{name}" for name in RECONSTRUCTION]
COMPARED += [f"rendering/{name}" for name in RENDERING]
KEYS = {
    *COMPARED,
    *(f"raw_prior/{name}" for name in COMPARED),
    *(f"{whose}segmentation/{name}" for whose in ("", "raw_prior/") for name in SEGMENTATION),
    *(f"reconstruction_{kind}/{name}" for kind in ("se3", "centers") for name in RECONSTRUCTION),
    *(f"frames/{name}" for name in ("tracked", "degraded", "lost", "apart", "initialization", "skipped", "overflow")),
    *("frames/longest_untracked", "frames/longest_untracked_from", "submaps/unjoined_frames"),
    *(f"time/{name}_seconds" for name in PHASES),
    *(f"map/{name}" for name in ("num_gaussians", "double_wall_percent", "num_tentative", "capacity")),
    *("time/seconds_per_frame", "memory/peak_mb", "provenance"),
}


def read_log(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]


def test_an_exact_prior_is_not_harmed_and_metrics_json_has_exactly_the_promised_keys(exact_run):
    metrics = exact_run[1]
    assert metrics["trajectory/ate_se3_m"] <= 0.01
    assert metrics["raw_prior/trajectory/ate_se3_m"] <= 1e-9
    assert metrics["frames/tracked"] == NUM_FRAMES - 1 and metrics["frames/initialization"] == 1
    assert set(metrics) == KEYS
    assert metrics["provenance"]["simulated"] is True and metrics["provenance"]["config"]["prior"]["level"] == 0


def test_the_labels_of_the_points_are_the_true_ones_where_prior_and_features_are_exact(exact_run):
    """But for the borders of objects, where a Gaussian is as large as the parts."""
    folder, metrics = exact_run
    assert metrics["segmentation/accuracy_percent"] > 90.0
    points, names = read_vertices(folder / "points.ply"), dataset().classes
    assert set(np.unique(points["label"])) <= set(range(len(names)))
    is_floor = points["label"] == names.index("floor")
    assert is_floor.sum() > 100 and np.abs(points["z"][is_floor]).mean() < 0.1  # the room stands on z = 0


@pytest.mark.slow
def test_the_command_writes_the_same_bytes_again_and_baselines_stand_beside_ours(
    tmp_path, monkeypatch, capsys, exact_run
):
    """The exact prior at its own poses has no error but the size of a voxel; at 64 pixels a view is coarse."""
    read, reads = Synthetic.__getitem__, Counter()

    def counted(self, index):
        reads[index] += 1
        return read(self, index)

    monkeypatch.setattr(Synthetic, "__getitem__", counted)
    monkeypatch.setattr(sys, "argv", ["emgs run", *TINY, "prior.level=0", "baseline=all", f"hydra.run.dir={tmp_path}"])
    experiments.run.main()
    said = capsys.readouterr().out
    assert "ours" in said and "raw prior" in said and str(tmp_path) in said
    for name in ("map.npz", "trajectory.txt"):
        assert (tmp_path / name).read_bytes() == (exact_run[0] / name).read_bytes()
    assert reads == dict.fromkeys(range(NUM_FRAMES), 1)  # mapping, the dense map, the truth and the report share it
    assert (tmp_path / "run.log").read_text() == said
    (took,) = re.findall(r"^[\d.]+ s, [\d.]+ s a frame: (.*); of all that compilation [\d.]+$", said, re.MULTILINE)
    phases = {name: float(seconds) for name, seconds in (part.split() for part in took.split(", "))}
    assert set(phases) == {*PHASES, "report"} - {"compile", "total"}
    for words in PHASE_WORDS:
        assert re.search(f"^{words}.* …$", said, re.MULTILINE), words
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    prefixes = [f"baseline_{name}_{kind}/" for name in ("voxel", "tsdf") for kind in ("raw", "ours")]
    keys = [key for key in COMPARED if not key.startswith("trajectory/")]
    assert set(metrics) == KEYS | {prefix + key for prefix in prefixes for key in keys}
    for prefix in prefixes:
        assert metrics[f"{prefix}reconstruction/accuracy_m"] < 0.05
        assert metrics[f"{prefix}rendering/coverage_percent"] > 80.0
    same = [key for key in KEYS if key.startswith(("trajectory/", "reconstruction", "rendering/"))]
    assert {key: metrics[key] for key in same} == {key: exact_run[1][key] for key in same}


@pytest.mark.slow
def test_a_back_end_moves_nothing_that_is_exact_and_writes_what_it_measured(tmp_path, exact_run):
    metrics = experiments.run.run(compose("prior.level=0", "graph=default"), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} >= FILES | {"trajectory_online.txt", "graph.g2o", "loops.json"}
    before, after = (load_trajectory_tum(folder / "trajectory.txt")[1] for folder in (exact_run[0], tmp_path))
    np.testing.assert_allclose(after, before, atol=1e-4)  # m
    online = load_trajectory_tum(tmp_path / "trajectory_online.txt")[1]
    np.testing.assert_allclose(online, before, atol=1e-6)
    assert metrics["trajectory_online/ate_se3_m"] < 1e-4 and metrics["loops/accepted"] == 0
    assert metrics["time/back_end_seconds"] > 0


def test_baselines_are_not_compared_with_poses_that_move(tmp_path):
    with pytest.raises(ValueError, match="use graph=none with it"):
        experiments.run.run(compose("graph=default", "baseline=voxel"), tmp_path)


def test_a_run_does_not_write_over_the_map_that_it_begins_with(tmp_path):
    with pytest.raises(ValueError, match="is the folder of this run, too"):
        experiments.run.run(compose(f"map={tmp_path}/../{tmp_path.name}"), tmp_path)


def test_the_phases_account_for_the_time(exact_run):
    metrics = exact_run[1]
    parts = sum(metrics[f"time/{name}_seconds"] for name in PHASES if name not in ("compile", "total"))
    assert parts <= metrics["time/total_seconds"] <= 1.1 * parts + 0.5
    assert 0 < metrics["time/seconds_per_frame"] < metrics["time/map_seconds"]


def test_every_file_is_there_and_the_trajectory_has_every_frame_at_its_time(exact_run):
    folder, metrics = exact_run
    assert {path.name for path in folder.iterdir()} == FILES | {"metrics.json"}
    times, poses = load_trajectory_tum(folder / "trajectory.txt")
    assert times.tolist() == [dataset()[i].timestamp for i in range(NUM_FRAMES)]
    truth = np.stack([dataset()[i].T_world_camera for i in range(NUM_FRAMES)])
    np.testing.assert_allclose(poses, truth, atol=1e-3)
    map = load_map(folder / "map.npz")
    num_confirmed, num_all = int(confirmed(map).valid.sum()), int(map.gaussians.valid.sum())
    assert num_confirmed == metrics["map/num_gaussians"] > 0 and num_all == read_log(folder)[-1]["num_gaussians"]
    assert num_all - num_confirmed == metrics["map/num_tentative"] > 0  # what only the last frame has seen


def test_an_interrupted_run_leaves_what_it_has(tmp_path, monkeypatch, exact_run):
    def interrupt(prediction):
        if prediction.window.inference == 2:
            raise KeyboardInterrupt
        return prediction

    whole = load_trajectory_tum(exact_run[0] / "trajectory.txt")
    monkeypatch.setattr(experiments.run, "build_prior", lambda config, dataset: EditedPrior(interrupt))
    with pytest.raises(KeyboardInterrupt):
        experiments.run.run(compose(), tmp_path)
    num_done = WINDOW_SIZE + 1
    records = read_log(tmp_path)
    assert [record["index"] for record in records] == list(range(num_done))
    times, poses = load_trajectory_tum(tmp_path / "trajectory.txt")
    np.testing.assert_array_equal(times, whole[0][:num_done])
    first, same = poses[0, :3, 3], whole[1][:num_done]
    np.testing.assert_allclose(poses[:, :3, :3], same[:, :3, :3], atol=1e-12)
    factor = np.linalg.norm(poses[-1, :3, 3] - first) / np.linalg.norm(same[-1, :3, 3] - first)  # each in its own unit
    np.testing.assert_allclose(poses[:, :3, 3], first + factor * (same[:, :3, 3] - first), atol=1e-6)
    map = load_map(tmp_path / "map.npz")
    assert int(map.gaussians.valid.sum()) == records[-1]["num_gaussians"]


@pytest.mark.slow
def test_a_bad_frame_is_left_out_and_listed_or_ends_the_run(tmp_path, monkeypatch):
    read = Synthetic.__getitem__

    def damaged(self, index):
        if index == 2:
            raise BadFrameError("frame-000002.png is truncated")
        return read(self, index)

    monkeypatch.setattr(Synthetic, "__getitem__", damaged)
    metrics = experiments.run.run(compose("prior.level=0", "on_bad_frame=skip"), tmp_path)
    records = read_log(tmp_path)
    assert [(r["index"], r["reason"]) for r in records if r["status"] == "skipped"] == [
        (2, "frame-000002.png is truncated")
    ]
    assert sorted(record["index"] for record in records) == list(range(NUM_FRAMES))
    assert load_trajectory_tum(tmp_path / "trajectory.txt")[0].tolist() == [0.0, 1.0, 3.0, 4.0, 5.0]
    assert metrics["frames/skipped"] == 1 and metrics["trajectory/ate_se3_m"] <= 0.01
    with pytest.raises(BadFrameError, match="frame-000002.png is truncated"):
        experiments.run.run(compose("prior.level=0"), tmp_path)


@pytest.mark.slow
def test_one_single_frame_is_mapped_and_says_why_it_has_no_trajectory_error(tmp_path):
    metrics = experiments.run.run(compose("prior.level=0", "dataset.stop=1", "graph=default"), tmp_path)
    assert json.loads((tmp_path / "loops.json").read_text()) == [] and not (tmp_path / "graph.g2o").exists()
    assert metrics["trajectory/ate_sim3_m"] is None and "poses" in metrics["trajectory/reason"]
    assert metrics["map/num_gaussians"] > 100 and metrics["reconstruction/accuracy_m"] < 0.05
    assert metrics["time/seconds_per_frame"] > 0 and {path.name for path in tmp_path.iterdir()} >= FILES


def test_an_error_of_a_constructor_is_one_clear_line(monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    prior = OmegaConf.merge(compose().prior, {"level": -1})
    with pytest.raises(SystemExit, match=r"^error: prior.level must be from 0 .*got -1") as caught, clear_errors():
        hydra.utils.instantiate(prior)
    assert caught.value.code not in (0, None)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(hydra.errors.InstantiationException), clear_errors():
        hydra.utils.instantiate(prior)


@pytest.mark.parametrize(
    ("unit", "continued", "expected"), [("m", None, True), (None, None, False), ("m", False, False)]
)
def test_a_map_that_is_continued_keeps_its_unit(tmp_path, capsys, unit, continued, expected):
    """Whatever the prior says: an own unit of yesterday was called metres where scale= was given today."""
    metric, own = {"scale": "metric"}, {"scale": "arbitrary", "median_depth": 2.0}
    block = {"format": RESULT_FORMAT, "prior": {"settings": metric if unit else own}, "metre": 0.4}
    block |= {} if continued is None else {"is_metric": continued}
    (tmp_path / "metrics.json").write_text(json.dumps({"provenance": block}))
    today = SimpleNamespace(metre=3.0, provenance=SimpleNamespace(settings=metric))
    assert experiments.run.unit_of_map(str(tmp_path), today) == (0.4, {"is_metric": expected})
    assert ("has a unit of its own and keeps it" in capsys.readouterr().out) == (not expected)
    assert is_in_metres({**block, "prior": {"settings": metric}, "is_metric": expected}) == expected
    assert experiments.run.unit_of_map(None, today) == (3.0, {})


@pytest.mark.parametrize("unit", ["m", "units"])
def test_a_map_is_scored_in_metres_only_if_it_has_them(monkeypatch, tmp_path, unit):
    """Symptom: a continued map of an own unit had errors without scale, as its prior has metres."""
    asked = []
    monkeypatch.setattr(experiments.run, "new_scorer", lambda *words: asked.append(words))
    monkeypatch.setattr(experiments.run, "score_prior", lambda *_: {})
    monkeypatch.setattr(experiments.run, "save_progress", lambda *_: 1 / 0)  # the rest is of no interest here
    with pytest.raises(ZeroDivisionError):
        experiments.run._write(SimpleNamespace(clock=Clock()), None, None, None, None, (None, None), tmp_path, unit)
    assert asked == [(None, None, None, unit == "m")]
