"""The sweep; oracle: `experiments.run` with the same values, whose metrics every row must repeat."""

import csv
import json
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import hydra
import numpy as np
import pytest
from tiny_run import CONF, compose

import experiments.run
import experiments.sweep
from experiments.grid import notes, read_axes, variants
from experiments.together import chunks_of

AXES = "axes={slam.em.max_mahalanobis_sq:[1.0,9.0],slam.em.average.gain:[count,ema_printed]}"
COMPARED = ("trajectory/", "reconstruction", "raw_prior/", "map/", "frames/")


@cache
def swept() -> tuple[Path, list[dict]]:
    """Folder and rows of a sweep over two axes, two settings a chunk."""
    folder = Path(mkdtemp())
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
def test_every_setting_has_the_metrics_of_a_run_with_its_values(tmp_path):
    for row in swept()[1]:
        values = [f"{name}={row[name]}" for name in ("slam.em.max_mahalanobis_sq", "slam.em.average.gain")]
        metrics = experiments.run.run(compose(*values), tmp_path)
        assert_same_metrics(row, metrics, 1e-5)
    assert len({row["trajectory/ate_sim3_m"] for row in swept()[1]}) == 4  # the axes do something


@pytest.mark.slow
def test_the_files_hold_every_row_and_the_recorded_predictions_are_removed():
    folder, rows = swept()
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
def test_a_finished_setting_is_not_mapped_again_and_another_sweep_is_not_mixed_in(monkeypatch, tmp_path):
    folder, rows = swept()
    (tmp_path / "sweep.json").write_bytes((folder / "sweep.json").read_bytes())
    monkeypatch.setattr(experiments.sweep, "map_and_score", None)  # calling it would fail
    subset = compose("axes={slam.em.max_mahalanobis_sq:[9.0],slam.em.average.gain:[count]}", name="sweep")
    (row,) = experiments.sweep.sweep(subset, tmp_path)
    assert row | {"setting": 2} == rows[2]
    with pytest.raises(ValueError, match=r"em\.noise 1\.0, and this one has 0\.5: .*another folder"):
        experiments.sweep.sweep(compose(AXES, "slam.em.noise=0.5", name="sweep"), tmp_path)
    (tmp_path / "sweep.json").write_text('{"format": "emgs_jax.running.stacked", "version": 99}')
    with pytest.raises(ValueError, match="version 1.*another folder"):
        experiments.sweep.sweep(subset, tmp_path)


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_its_chunks(monkeypatch, tmp_path):
    done = []

    def interrupted(work, chunk, bar):
        if done:
            raise KeyboardInterrupt
        done.extend(variant.setting for variant in chunk)
        return [{"map/num_gaussians": 1}] * len(chunk)

    monkeypatch.setattr(experiments.sweep, "map_and_score", interrupted)
    with pytest.raises(KeyboardInterrupt):
        experiments.sweep.sweep(compose(AXES, "chunk=2", name="sweep"), tmp_path)
    kept = json.loads((tmp_path / "sweep.json").read_text())["settings"]
    assert [row["setting"] for row in kept] == done and len(done) == 2


@pytest.mark.slow
def test_a_sweep_that_is_stopped_and_goes_on_has_the_same_bits_and_the_same_chunks(monkeypatch, tmp_path, capsys):
    folder, _ = swept()
    chunks, map_and_score = [], experiments.sweep.map_and_score

    def stopped(work, chunk, bar):
        chunks.append([variant.setting for variant in chunk])
        if len(chunks) == 2:
            raise KeyboardInterrupt
        return map_and_score(work, chunk, bar)

    monkeypatch.setattr(experiments.sweep, "map_and_score", stopped)
    with pytest.raises(KeyboardInterrupt):
        experiments.sweep.sweep(compose(AXES, "chunk=2", name="sweep"), tmp_path)
    (tmp_path / ".sweep.999999999.tmp.json").write_text("{")  # as a kill leaves it
    experiments.sweep.sweep(compose(AXES, "chunk=2", name="sweep"), tmp_path)
    assert "going on: 2 of 4 settings are left" in capsys.readouterr().out
    assert len(chunks) == 3 and chunks[2] == chunks[1]
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in folder.iterdir()}
    assert (tmp_path / "sweep.csv").read_bytes() == (folder / "sweep.csv").read_bytes()
    kept, whole = (json.loads((place / "sweep.json").read_text())["settings"] for place in (tmp_path, folder))
    assert kept == whole
    assert (tmp_path / "report.html").read_bytes() == (folder / "report.html").read_bytes()


def test_what_is_left_is_in_the_chunks_of_the_whole_grid():
    """On an accelerator a chunk is stacked, and stacks of other sizes may round otherwise."""
    config = compose("axes={slam.em.normal_weight:[0,1,2,3,4,5,6]}", name="sweep")
    whole = chunks_of(variants(config, read_axes(config)), 3)
    for count in range(len(whole) + 1):
        done = [variant.setting for chunk in whole[:count] for variant in chunk]
        assert experiments.sweep._left(whole, done) == whole[count:]
    assert [len(chunk) for chunk in experiments.sweep._left(whole, [whole[0][1].setting])] == [2, 2, 2]


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


def test_a_grid_that_is_none_is_refused():
    with pytest.raises(ValueError, match="grid must be one of product, one_at_a_time, got 'random'"):
        read_axes(compose(AXES, "grid=random", name="sweep"))


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
        ("null", "no axis: choose one with sweep=gates"),
        ("{slam.em.max_mahalanobis:[3]}", r"no key of a stage; near names: slam\.em\.max_mahalanobis_sq"),
        ("{max_mahalanobis_sq:[3]}", r"near names: .*em\.max_mahalanobis_sq|near names: .*max_mahalanobis_sq"),
        ("{slam.em.noise:3}", r"must be a list of values, got 3: write slam\.em\.noise: \[3"),
        ("{slam.em.noise:[]}", "must be a list of values"),
        ("{slam.em.noise:[[1,2]]}", "numbers or names"),
        ("{prior.seed:[0,1]}", r"experiments\.sweep -m prior\.seed"),
    ],
)
def test_an_axis_that_is_none_is_refused_with_the_remedy(axes, message):
    with pytest.raises(ValueError, match=message):
        read_axes(compose(f"axes={axes}", name="sweep"))


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


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "sweep").glob("*.yaml")))
def test_every_sweep_of_conf_has_axes_whose_values_build_configs(name):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        config = hydra.compose("sweep", overrides=[f"sweep={name}"])
    axes = read_axes(config)
    sizes = [len(values) for values in axes.values()]
    assert len(variants(config, axes)) == (np.prod(sizes) if config.grid == "product" else sum(sizes) - len(axes) + 1)
