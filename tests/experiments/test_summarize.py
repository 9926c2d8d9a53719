"""The table over runs, against means and spreads worked out by hand."""

import json

import pytest

from experiments.summarize import read_runs, table


def write_run(folder, ate, initialization="incremental", settings=None):
    config = {
        "slam": {"initialization": initialization},
        "dataset": {"_target_": "emgs_jax.data.replica.Replica"},
        "prior": {"_target_": "emgs_jax.prior.simulated.Simulated", "level": 1.0},
    }
    folder.mkdir(parents=True)
    provenance = {"config": config, "prior": {"settings": settings or {}}}
    metrics = {"trajectory/ate_sim3_m": ate, "raw_prior/trajectory/ate_sim3_m": 0.05, "provenance": provenance}
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_a_row_holds_mean_and_sample_spread_of_its_seeds_and_presets_stay_apart(tmp_path):
    write_run(tmp_path / "0", 0.02)
    write_run(tmp_path / "1", 0.04)
    write_run(tmp_path / "2", 0.10, "merged")
    write_run(tmp_path / "3", 0.20, settings={"features": {"model": {"name": "dinov3_text"}}})
    lines = table(read_runs([str(tmp_path)])).splitlines()
    # stdev(2, 4) = sqrt(2) = 1.4; a value that is missing shows as a dash
    assert lines[2].startswith("| replica, simulated 1, default | ours | 2 | 3.0 ± 1.4 | – |")
    assert lines[3].startswith("| replica, simulated 1, default | raw prior | 2 | 5.0 ± 0.0 | – |")
    assert lines[4].startswith("| replica, simulated 1, paper | ours | 1 | 10.0 | – |")
    assert lines[6].startswith("| replica, simulated 1 + dinov3_text, default | ours | 1 | 20.0 | – |")


def test_a_folder_without_runs_says_what_to_do(tmp_path):
    with pytest.raises(SystemExit, match="experiments.run first"):
        read_runs([str(tmp_path)])
