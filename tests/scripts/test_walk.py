"""What a run with a loop leaves behind is read by every other command, and by the next run in its map."""

import json
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest

import experiments.run
from emgs_jax.running import configure
from emgs_jax.running.record import FOUND
from experiments.export import export_run
from experiments.query import query
from experiments.segment import segment

pytestmark = pytest.mark.slow

# Any two views that share a place are a loop here, and each is worth a closure, so that ten frames have one.
EAGER = ("appearance.min_gap=5", "appearance.suppressed_gap=2", "max_known=0", "min_frames=1", "agreement.min_others=0")
WALK = ("experiment=smoke", "dataset.num_frames=120", "prior.version=2", "graph=default")
WALK += tuple(f"graph.{word}" for word in EAGER)


def run(folder: Path, *words: str) -> dict:
    return experiments.run.run(configure.compose(*WALK, *words), folder)


@cache
def walked() -> tuple[Path, dict]:
    folder = Path(mkdtemp())
    return folder, run(folder, "dataset.stop=11")


def test_a_walk_whose_loop_is_closed_can_be_asked_scored_and_exported(tmp_path):
    folder, metrics = walked()
    assert metrics["loops/accepted"] >= 1 and metrics["loops/closures"] >= 1
    found = query(configure.compose(f"map={folder}", "text=wall", f"out={tmp_path}", name="query"))
    assert found["features"]["num_gaussians"] == metrics["map/num_gaussians"] and found["words"][0]["instances"]
    scores, _ = segment(configure.compose(f"map={folder}", "truth=frames", f"out={tmp_path}", name="segment"))
    assert scores["total"]["miou"] == pytest.approx(metrics["segmentation/miou_percent"])
    assert {path.name for path in export_run(configure.compose(f"folder={folder}", f"out={tmp_path}", name="export"))}


@pytest.mark.long
@pytest.mark.parametrize("mode", ["extend", "locate"])
def test_another_run_in_its_map_ends_with_all_its_files(mode, tmp_path):
    folder, before = walked()
    metrics = run(tmp_path, "dataset.start=3", "dataset.stop=8", "prior.seed=7", f"map={folder}", f"map_mode={mode}")
    lines = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert [line["status"] for line in lines] == ["tracked"] * 5 and lines[0]["location"] == FOUND
    missing = {path.name for path in folder.iterdir()} - {path.name for path in tmp_path.iterdir()}
    assert missing == (set() if mode == "extend" else {"graph.g2o", "loops.json", "trajectory_online.txt"})
    if mode == "locate":
        assert metrics["map/num_gaussians"] == before["map/num_gaussians"]
        assert metrics["loops/accepted"] == metrics["loops/closures"] == 0
        saved, written = (np.load(path / "map.npz") for path in (folder, tmp_path))
        assert all(np.array_equal(saved[name], written[name]) for name in saved.files)
