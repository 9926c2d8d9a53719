"""A run that is saved while it goes on; oracles: the run that is not, and the run that ends there."""

import jax
import numpy as np
import pytest
import tiny_run
from omegaconf import OmegaConf
from scene import assert_same

from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.config.configure import build, graph_config
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.run import new_run
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.provenance import provenance
from emgs_jax.runs.snapshot import save_snapshot

pytestmark = pytest.mark.xdist_group("tiny")
NUM_SAVED = 4


class Recorded:
    """The tiny room as a camera's data set that keeps its images."""

    def __init__(self, folder) -> None:
        self._room, self._folder = tiny_run.dataset(), folder

    def __getattr__(self, name):
        return getattr(self._room, name)

    def recording(self):
        return {"root": str(self._folder / "recorded"), "stop": None}


def test_a_snapshot_is_a_finished_run_and_changes_nothing(tmp_path):
    config = tiny_run.compose("graph=default", "graph.every=1")
    prior, room = tiny_run.EditedPrior(), Recorded(tmp_path)
    origin = provenance(OmegaConf.to_container(config, resolve=True), tiny_run.dataset(), prior.provenance)
    (tmp_path / "recorded").mkdir()
    run = start = new_run(tiny_run.dataset(), build(config, "slam"), graph=graph_config(config))
    with pytest.raises(ValueError, match="nothing is mapped yet"):
        save_snapshot(tmp_path, start, (room, prior), origin)
    for run, _, _ in map_frames(start, tiny_run.dataset(), prior):
        if len(run.records) == NUM_SAVED:
            expected = finish_run(run, is_interrupted=True)
            first = save_snapshot(tmp_path, run, (room, prior), origin)
    last = save_snapshot(tmp_path, run, (room, prior), origin, "recorded")
    assert (first, last) == (tmp_path / "saved-1", tmp_path / "saved-2")

    found = read_run(first)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)
    assert_same(jax.device_get(found.map), jax.device_get(expected.map))
    assert [frame["index"] for frame in found.frames] == [*range(NUM_SAVED)]
    images = found.provenance["config"]["dataset"]
    assert images == {"root": str(tmp_path / "recorded"), "stop": NUM_SAVED} and origin["config"]["dataset"] != images
    assert read_run(last).provenance["config"]["dataset"]["root"] == str(last / "recorded")
    assert (last / "recorded").is_dir() and not (tmp_path / "recorded").exists(), "the recording has moved along"
    again = load_saved_map(str(first), "extend", graph_config(config), room.intrinsics, 0.01)
    assert len(again.back_end.nodes) == NUM_SAVED, "another run can go on with it"

    *_, (alone, _, _) = map_frames(start, tiny_run.dataset(), prior)
    assert_same(jax.device_get(finish_run(run).map), jax.device_get(finish_run(alone).map))
