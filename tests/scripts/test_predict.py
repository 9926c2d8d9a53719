"""Recording and replay; oracle: the live run's bytes."""

import json
from dataclasses import replace
from pathlib import Path

import hydra
import numpy as np
import pytest
from scipy.spatial import cKDTree
from tiny_run import NUM_FRAMES, WINDOW_SIZE, compose, dataset

import experiments.predict
import experiments.run
from emgs_jax.config.configure import build_prior
from emgs_jax.prior.base import windows
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.prior.wrapped import Wrapped
from emgs_jax.runs.finished_run import read_run
from experiments.predict import predict
from experiments.run import run

pytestmark = pytest.mark.xdist_group("tiny")


def record(folder: Path, *overrides: str) -> Path:
    return predict(compose(f"out={folder}", *overrides, name="predict"))


def test_the_recording_holds_what_the_prior_says_of_every_window(tmp_path, capsys):
    record(tmp_path / "out")
    said = capsys.readouterr().out
    assert "simulated" in said and "'level': 1.0" in said
    size = sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) / 2**20
    assert f"{size:.1f} MiB, {size / NUM_FRAMES:.2f} a frame" in said
    prior = hydra.utils.instantiate(compose().prior, classes=list(dataset().classes))
    calls = list(windows(range(NUM_FRAMES).__contains__, WINDOW_SIZE))
    for window in calls:
        frames = [dataset()[index] for index in window.views]
        expected = prior.predict(window, frames, dataset().intrinsics)
        with np.load(tmp_path / "out" / f"{window.inference:06d}.npz") as arrays:
            np.testing.assert_array_equal(arrays["points"], expected.points)
            np.testing.assert_array_equal(arrays["T_anchor_view"], expected.T_anchor_view)
    assert len(list((tmp_path / "out").glob("0*.npz"))) == len(calls)


def test_with_a_back_end_places_that_are_seen_twice_are_recorded_too(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(experiments.predict, "places_seen_twice", lambda *_: [(0, 4), (1, 5)])
    folder = record(tmp_path / "out", "graph=default", "graph.prior_query.spacing=1")
    assert "2 windows with both visits of a place" in capsys.readouterr().out
    names = sorted(path.name for path in folder.glob("visits_*"))
    assert names == ["visits_000000_000001_000003_000004.npz", "visits_000001_000000_000002_000004_000005.npz"]
    none = record(tmp_path / "none", "graph=default", "graph.prior_query.is_used=false")
    assert not list(none.glob("visits_*")) and "visits" not in capsys.readouterr().out


def test_a_folder_that_holds_a_run_is_refused(tmp_path):
    """The recording lay among the files of a run, and its size was that of all of them."""
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "map.ply").write_text("")
    with pytest.raises(ValueError, match=r"holds map.ply, metrics.json and no recording: give a folder of its own"):
        record(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_what_a_prior_measures_of_itself_is_printed(tmp_path, capsys, monkeypatch):
    record(tmp_path / "silent")
    assert "prior/" not in capsys.readouterr().out
    monkeypatch.setattr(Simulated, "report", lambda self: {"prior/seconds_per_inference": 1.25}, raising=False)
    record(tmp_path / "measured")
    assert "prior/seconds_per_inference 1.25" in capsys.readouterr().out


@pytest.mark.slow
def test_a_run_from_the_recording_writes_the_same_bytes_as_the_live_run(tmp_path, exact_run):
    folder = record(tmp_path / "out", "prior.level=0")
    (tmp_path / "replay").mkdir()
    run(compose("prior=recorded", f"prior.folder={folder}"), tmp_path / "replay")
    for name in ("map.npz", "trajectory.txt", "map.ply", "points.ply", "mesh.ply"):
        assert (tmp_path / "replay" / name).read_bytes() == (exact_run[0] / name).read_bytes(), name
    live, replay = exact_run[1], json.loads((tmp_path / "replay" / "metrics.json").read_text())
    same = [key for key in live if not key.startswith(("time/", "memory/", "provenance"))]
    assert {key: live[key] for key in same} == {key: replay[key] for key in same}
    assert replay["provenance"]["prior"] == live["provenance"]["prior"] and replay["provenance"]["simulated"] is True


class Quadruple(Wrapped):
    """A prior in another unit, in which all lengths are four times as long."""

    metre = 4.0

    def predict(self, window, frames, intrinsics):
        found = super().predict(window, frames, intrinsics)
        T = found.T_anchor_view.copy()
        T[:, :3, 3] *= 4
        return replace(found, T_anchor_view=T, points=4 * found.points)


@pytest.mark.slow
@pytest.mark.parametrize("is_recorded", [False, True])
def test_a_map_in_another_unit_is_the_same_map(tmp_path, exact_run, monkeypatch, is_recorded, capsys):
    """Symptom: a given model of COLMAP, in its own unit, made a worse map than the same structure made by the run."""
    words, module = ("prior.level=0",), experiments.predict if is_recorded else experiments.run
    monkeypatch.setattr(module, "build_prior", lambda *parts: Quadruple(build_prior(*parts)))
    if is_recorded:
        folder = record(tmp_path / "recording", *words)
        words = "prior=recorded", f"prior.folder={folder}"
    (tmp_path / "run").mkdir()
    metrics = run(compose(*words), tmp_path / "run")
    assert "count 4 times, for the unit of the map" in "".join(capsys.readouterr())
    there, here = np.load(tmp_path / "run" / "map.npz"), np.load(exact_run[0] / "map.npz")
    (means, stds), (others, expected) = (
        (found["gaussians.means"][rows], np.sqrt(np.linalg.eigvalsh(found["gaussians.covs"][rows])[:, 0]))
        for found, rows in ((found, found["gaussians.valid"]) for found in (there, here))
    )
    assert abs(len(means) - len(others)) <= 0.02 * len(others)  # without noise, rounding decides some
    first = np.loadtxt(exact_run[0] / "trajectory.txt")[0, 1:4]  # where both maps begin
    assert np.mean(cKDTree(first + 4 * (others - first)).query(means)[0] < 0.02) > 0.75
    assert np.median(stds) == pytest.approx(4 * np.median(expected), rel=0.05)
    assert metrics["provenance"]["metre"] == 4.0 and metrics["provenance"]["config"]["slam"]["fit"]["min_std"] == 0.01
    assert read_run(tmp_path / "run").metre == 4.0
