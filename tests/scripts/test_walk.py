"""What a run with a loop leaves behind is read by every other command; mapping/test_coming_back.py goes on in it."""

import pytest

import experiments.run
from emgs_jax.config import configure
from experiments.export import export_run
from experiments.query import query
from experiments.segment import segment

pytestmark = [pytest.mark.weekly, pytest.mark.xdist_group("smoke")]

# Any two views that share a place are a loop here, and each is worth a closure, so that ten frames have one.
EAGER = (
    "place_recognition.min_gap=5",
    "place_recognition.suppressed_gap=2",
    "min_violation=0",
    "min_frames=1",
    "consistency.min_others=0",
)
WALK = ("experiment=smoke", "dataset.num_frames=120", "prior.version=2", "graph=default")
WALK += tuple(f"graph.{word}" for word in EAGER)


def test_a_walk_whose_loop_is_closed_can_be_asked_scored_and_exported(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    metrics = experiments.run.run(configure.compose(*WALK, "dataset.stop=11"), folder)
    assert metrics["loops/accepted"] >= 1 and metrics["loops/closures"] >= 1
    found = query(configure.compose(f"map={folder}", "text=wall", f"out={tmp_path}", name="query"))
    assert found["features"]["num_gaussians"] == metrics["map/num_gaussians"] and found["words"][0]["instances"]
    scores, _ = segment(configure.compose(f"map={folder}", "truth=frames", f"out={tmp_path}", name="segment"))
    assert scores["total"]["miou"] == pytest.approx(metrics["segmentation/miou_percent"])
    assert {path.name for path in export_run(configure.compose(f"folder={folder}", f"out={tmp_path}", name="export"))}
