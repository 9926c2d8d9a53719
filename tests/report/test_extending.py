"""What docs/extending.md shows works as it stands there: a prior, a data set and a metric in a folder of one's own."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from written_run import written_run

from emgs_jax.config.configure import build_dataset, build_prior, compose
from emgs_jax.prior.base import windows
from emgs_jax.runs.results import read_estimates
from experiments.command import check_arguments

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"


@pytest.fixture
def mine(tmp_path, monkeypatch) -> Path:
    """The folder with the files of the page."""
    listings = re.findall(r"```(?:python|yaml)\n# (\S+)\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(listings) == 5
    for name, content in listings:
        assert len(list(filter(str.strip, content.splitlines()))) <= 15, name
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_data_set_and_a_prior_of_ones_own_are_options_of_every_command(mine):
    images = np.random.default_rng(0).integers(0, 256, (4, 24, 32, 3), np.uint8)
    np.save(mine / "clip.npy", images)
    words = [f"hydra.searchpath=[file://{mine}/configs]", "dataset=Stack", f"dataset.file={mine}/clip.npy"]
    words += ["dataset.intrinsics=[40,40,15.5,11.5]", "prior=Wall", "prior.depth=3.0"]
    check_arguments("config", words)
    config = compose(*words)
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    window = next(windows(range(len(dataset)).__contains__, 3))
    found = prior.predict(window, [dataset[view] for view in window.views], dataset.intrinsics)
    assert prior.provenance.settings == {"depth": 3.0} and found.mask.all() and found.points.shape == (3, 24, 32, 3)
    np.testing.assert_allclose(found.points[1, 5, 7], [3 * (7 - 15.5) / 40, 3 * (5 - 11.5) / 40, 3.0], rtol=1e-6)
    np.testing.assert_array_equal(dataset[2].image, images[2])


def test_a_metric_of_ones_own_stands_beside_ours(mine, monkeypatch):
    """The path of the written run has equal steps of 10 cm; its fourth frame is lost, so one step is of 20."""
    written_run(mine / "results" / "synthetic" / "room" / "default" / "0")
    monkeypatch.setattr("sys.argv", ["jerk.py", str(mine / "results")])
    runpy.run_path(str(mine / "jerk.py"))
    ours = read_estimates(mine / "results")[0]
    assert ours.kind == "ours" and ours.values["trajectory/ate_sim3_m"] == 0.012
    np.testing.assert_allclose(ours.values["mine/jerk_m"], 0.1, atol=1e-6)
