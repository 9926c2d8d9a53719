"""The sweep; oracle: `experiments.run` with the same values, whose metrics every row must repeat."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tiny_run import compose

import experiments.run
import experiments.sweep
import experiments.together
from emgs_jax.config import configure
from emgs_jax.config.configure import groups
from experiments.grid import notes, read_axes, variants

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]

AXES = "axes={slam.em.max_mahalanobis_sq:[1.0,9.0],slam.em.average.gain:[count,ema_printed]}"
COMPARED = ("trajectory/", "reconstruction", "raw_prior/", "map/", "frames/")


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> tuple[Path, list[dict]]:
    """Folder and rows of a sweep over two axes, two settings a chunk."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / ".sweep.999999999.tmp.json").write_text("{")  # as a kill leaves it
    return folder, experiments.sweep.sweep(compose(AXES, "chunk=2", name="sweep"), folder)


def assert_same_metrics(row: dict, metrics: dict, rtol: float) -> None:
    names = {name for name in metrics if name.startswith(COMPARED)}
    assert names == {name for name in row if name.startswith(COMPARED)} and len(names) > 40
    for name in names:
        if isinstance(metrics[name], float):
            np.testing.assert_allclose(row[name], metrics[name], rtol=rtol, atol=rtol, err_msg=name)
        else:
            assert row[name] == metrics[name], name


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, *(pytest.param(number, marks=pytest.mark.weekly) for number in (0, 2, 3))])
def test_every_setting_has_the_metrics_of_a_run_with_its_values(swept, tmp_path, number):
    row = swept[1][number]
    values = [f"{name}={row[name]}" for name in ("slam.em.max_mahalanobis_sq", "slam.em.average.gain")]
    assert_same_metrics(row, experiments.run.run(compose(*values), tmp_path), 1e-5)
    assert len({row["trajectory/ate_sim3_m"] for row in swept[1]}) == 4  # the axes do something


@pytest.mark.slow
def test_the_files_hold_every_row_and_the_recorded_predictions_are_removed(swept):
    folder, rows = swept
    names = {"sweep.json", "sweep.csv", "heat_map.png", "report.html", "pictures"}
    assert {path.name for path in folder.iterdir()} == names and len(list((folder / "pictures").iterdir())) == 4
    with open(folder / "sweep.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [float(line["trajectory/ate_sim3_m"]) for line in lines] == [row["trajectory/ate_sim3_m"] for row in rows]
    assert [line["slam.em.average.gain"] for line in lines] == ["count", "ema_printed"] * 2
    written = json.loads((folder / "sweep.json").read_text())
    assert written["provenance"]["simulated"] is True and len(written["settings"]) == 4
    assert (folder / "heat_map.png").read_bytes()[:4] == b"\x89PNG"
    assert (folder / "report.html").read_text().count("<img ") == 5  # the heat map and a map of each setting


@pytest.mark.slow
def test_a_finished_setting_is_not_mapped_again_and_another_sweep_is_not_mixed_in(swept, monkeypatch, tmp_path):
    folder, rows = swept
    (tmp_path / "sweep.json").write_bytes((folder / "sweep.json").read_bytes())
    monkeypatch.setattr(experiments.together, "map_and_score", None)  # calling it would fail
    subset = compose("axes={slam.em.max_mahalanobis_sq:[9.0],slam.em.average.gain:[count]}", name="sweep")
    (row,) = experiments.sweep.sweep(subset, tmp_path)
    assert row | {"setting": 2} == rows[2]
    with pytest.raises(ValueError, match=r"em\.noise was 1\.0, now it is 0\.5\): .*another folder"):
        experiments.sweep.sweep(compose(AXES, "slam.em.noise=0.5", name="sweep"), tmp_path)


@pytest.mark.slow
def test_a_sweep_that_is_stopped_keeps_its_chunks_and_goes_on_with_those_of_the_whole_grid(
    monkeypatch, tmp_path, capsys
):
    """On an accelerator a chunk is stacked, and stacks of other sizes may round otherwise."""
    chunks = []

    def stopped(work, prior, chunk, bar):
        chunks.append([variant.setting for variant in chunk])
        if len(chunks) == 2:
            raise KeyboardInterrupt
        return [{"map/num_gaussians": 1}] * len(chunk)

    config = compose(AXES.replace("9.0]", "4.0,9.0]"), "chunk=2", name="sweep")
    monkeypatch.setattr(experiments.together, "map_and_score", stopped)
    with pytest.raises(KeyboardInterrupt):
        experiments.sweep.sweep(config, tmp_path)
    kept = json.loads((tmp_path / "sweep.json").read_text())["settings"]
    assert [row["setting"] for row in kept] == chunks[0] and len(kept) == 2
    experiments.sweep.sweep(config, tmp_path)
    assert "going on: 4 of 6 settings are left" in capsys.readouterr().out
    assert chunks[2] == chunks[1] and [len(chunk) for chunk in chunks] == [2] * 4


def test_the_grid_is_every_combination_and_shared_nodes_change_wherever_they_are_used():
    config = compose("axes={slam.em.normal_weight:[0,5],render.opacity:[0.5,0.7]}", name="sweep")
    grid = variants(config, read_axes(config))
    got = [
        (float(v.slam.em.normal_weight), float(v.slam.refinement.render.opacity), float(v.densify.render.opacity))
        for v in grid
    ]
    np.testing.assert_allclose(got, [(0, 0.5, 0.5), (0, 0.7, 0.7), (5, 0.5, 0.5), (5, 0.7, 0.7)])
    assert [v.setting for v in grid][1] == {"slam.em.normal_weight": 0, "render.opacity": 0.7}


def test_one_at_a_time_keeps_the_other_keys_as_the_config_has_them():
    axes = "axes={slam.em.normal_weight:[0,5.0,9],slam.em.average.gain:[ema_printed,count]}"
    config = compose(axes, "grid=one_at_a_time", name="sweep")
    settings = [tuple(v.setting.values()) for v in variants(config, read_axes(config))]
    assert settings == [(5.0, "count"), (0, "count"), (9, "count"), (5.0, "ema_printed")]


@pytest.mark.parametrize("word", ["baseline=voxel", "graph=default"])
def test_baselines_and_loops_are_no_part_of_a_sweep(tmp_path, word):
    with pytest.raises(ValueError, match=f"{word.split('=')[0]}= is for run and evaluate"):
        experiments.sweep.sweep(compose(word, name="sweep"), tmp_path)


def test_an_infinite_value_is_text_in_the_results():
    config = compose("axes={slam.em.max_log_gap:[8.0,inf]}", name="sweep")
    grid = variants(config, read_axes(config))
    assert [v.setting["slam.em.max_log_gap"] for v in grid] == [8.0, "inf"] and np.isinf(grid[1].slam.em.max_log_gap)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"slam.em.noise": []}, "must be a list of values"),
        ({"slam.em.noise": [[1, 2]]}, "numbers or names"),
        ({"prior.seed": [0, 1]}, r"experiments\.sweep -m prior\.seed"),
    ],
)
def test_an_axis_that_is_none_is_refused_with_the_remedy(axes, message):
    config = compose(name="sweep")
    config.axes = axes
    with pytest.raises(ValueError, match=message):
        read_axes(config)


def test_a_static_axis_says_that_it_compiles_for_each_value_and_a_traced_one_says_nothing():
    config = compose(
        "axes={slam.em.num_neighbours:[4,6],slam.em.noise:[0,1],slam.observation.min_confidence:[1.0,2.0]}",
        name="sweep",
    )
    said = notes(config, read_axes(config))
    assert said == [
        "slam.em.num_neighbours is static: it compiles once for each of its 2 values",
        "slam.observation.min_confidence decides what a prediction becomes: its 2 values are mapped in turn",
    ]


@pytest.mark.parametrize("name", groups()["sweep"])
def test_every_sweep_of_conf_has_axes_whose_values_build_configs(name):
    config = configure.compose(f"sweep={name}", name="sweep")
    axes = read_axes(config)
    sizes = [len(values) for values in axes.values()]
    assert len(variants(config, axes)) == (np.prod(sizes) if config.grid == "product" else sum(sizes) - len(axes) + 1)
