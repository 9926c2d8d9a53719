"""The benchmark; oracles: the slow reference for the baselines, the library for what both compute, the files."""

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from tiny_run import compose

import experiments.benchmark
from emgs_jax.render.composite import RenderConfig
from experiments.benchmarks import baselines, comparisons
from experiments.benchmarks.comparisons import time_icp, time_render
from experiments.benchmarks.data import enlarged, first_state, load
from experiments.benchmarks.timing import Candidate, Timing, compare, interleaved, spread

TINY = ("benchmark.repetitions=2", "benchmark.num_gaussians=200")


def benchmark_config(*overrides: str):
    return compose("prior.level=0.3", *TINY, *overrides, name="benchmark")


def gaussian_arrays(count: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
    return {
        "means": rng.uniform(-1, 1, (count, 3)),
        "covs": np.einsum("nij,nj,nkj->nik", axes, rng.uniform(0.05, 0.3, (count, 3)) ** 2, axes),
        "normals": unit(rng.normal(size=(count, 3)) * 0.3 + [0, 0, -1]),
        "colors": rng.uniform(0, 1, (count, 3)),
        "features": unit(rng.normal(size=(count, 4)) + 2.0),
        "valid": np.ones(count, bool),
    }


def test_the_array_form_of_em_is_what_the_equations_say_point_by_point():
    weights = {"noise": 0.0, "determinant_weight": 0.5, "normal_weight": 5.0, "feature_weight": 2.0}
    gates = {"min_normal_cos": 0.5, "max_mahalanobis_sq": 4.0, "max_log_gap": 8.0, "min_responsibility": 1.0}
    config = SimpleNamespace(num_neighbours=5, min_std=0.01, **weights, **gates)
    g, points = gaussian_arrays(30, 0), gaussian_arrays(200, 1)
    points["points"] = points.pop("means")
    update = baselines.em(g, points, np.zeros((200, 3)), config)
    seen = points["points"], points["normals"], points["features"], np.zeros((200, 3)), np.ones(200, bool)
    expected, is_fused, _ = reference.e_step(*seen, g, config)
    dense = np.zeros_like(expected)
    np.put_along_axis(dense, update.rows, update.responsibilities, axis=1)
    np.testing.assert_allclose(dense, expected, atol=1e-10)
    assert 20 < is_fused.sum() < 200
    for k in range(30):
        new = {name: value[k] for name, value in update.parameters.items()}
        if expected[:, k].sum() > 1.0:
            truth = reference.m_step(expected, points["points"], points["normals"], points["colors"], k, 0.01)
            for a, b in zip((new["means"], new["covs"], new["normals"], new["colors"]), truth, strict=True):
                np.testing.assert_allclose(a, b, atol=1e-9)
        else:
            np.testing.assert_array_equal(new["means"], g["means"][k])


def test_compositing_without_tiles_is_the_reference_pixel_by_pixel():
    g = gaussian_arrays(25, 2)
    g["means"][:, 2] += 3.0
    camera = SimpleNamespace(focal=[20.0, 23.0], center=[11.5, 8.25], width=24, height=18)
    config = RenderConfig(8, 32, 4, opacity=0.8, covariance_scale=1.5, blur=0.3, radius=2.5, min_alpha=0.1)
    expected, *_ = reference.render(g, g["colors"], np.eye(4), camera, config)
    drawn = [reference.splat(m, c, np.eye(4), camera, 1.5, 0.3)[:2] for m, c in zip(g["means"], g["covs"], strict=True)]
    splats = {
        "means": np.stack([mean for mean, _ in drawn]),
        "precisions": np.linalg.inv(np.stack([cov for _, cov in drawn])),
        "depth": g["means"][:, 2],
    }
    image = baselines.render(splats, g["colors"], 24, range(18), config)
    np.testing.assert_allclose(image, expected, atol=1e-5)  # the config holds float32
    some = baselines.render(splats, g["colors"], 24, [3, 11], config)
    np.testing.assert_array_equal(some, image[[3, 11]])
    assert expected.max() > 0.3


def test_candidates_take_turns_and_a_ratio_compares_the_same_turn(monkeypatch):
    order, clock = [], iter(np.cumsum([0, 5, 0, 1, 0, 20, 0, 5, 0, 40, 0, 5, 0, 80, 0, 5]) / 1e3)
    monkeypatch.setattr("experiments.benchmarks.timing.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    timings = compare(interleaved("part", {name: Candidate(partial(order.append, name)) for name in "ab"}, 3), "a")
    assert order == ["a", "b"] * 4  # the first turn does not count
    np.testing.assert_allclose(timings[0].seconds, [0.02, 0.04, 0.08])
    np.testing.assert_allclose(timings[1].facts["times_faster_than"]["a"], (8, 4, 16))
    assert spread([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)
    assert np.isclose(comparisons.color_error(np.linspace(0, -1, 1001), np.zeros(1001)), 0.999)
    assert comparisons.color_error(np.ones(2), np.ones(2)) == 0.0
    part = comparisons.of_all_lines(Timing("render", "a part", [0.1, 0.2], facts={"drawn_lines": 3}), 12)
    np.testing.assert_allclose(part.seconds, [0.4, 0.8])
    assert comparisons.of_all_lines(timings[0], 12) == timings[0]


def written(folder, timings) -> str:
    """benchmark.md, after a look whether both files have every timing."""
    about, text = json.loads((folder / "benchmark.json").read_text()), (folder / "benchmark.md").read_text()
    assert [row["name"] for row in about["timings"]] == [timing.name for timing in timings]
    assert all(f"| {timing.name} |" in text for timing in timings) and about["provenance"]["device"]["kind"] in text
    assert all(len(timing.seconds) == 2 and min(timing.seconds) > 0 for timing in timings)
    return text


@pytest.mark.slow
def test_em_agrees_with_numpy_and_scipy_on_the_same_points_and_the_files_say_so(tmp_path):
    # Of 200, one gets a single point, and whether its 1 exceeds `min_responsibility`, 1, is a matter of rounding.
    config = benchmark_config("benchmark.num_gaussians=250", "parts=[em]")
    ours, theirs = experiments.benchmark.benchmark(config, tmp_path)
    # The list that a block of points shares may lack the farthest neighbour of one of them.
    assert ours.facts["neighbours_listed_percent"] >= 99 and ours.facts["responsibility_error"] <= 1e-4
    assert ours.facts["mean_error_m_999"] <= 1e-5 and ours.compile_seconds > 0 and theirs.compile_seconds is None
    assert "neighbours_listed_percent" in written(tmp_path, [ours, theirs])


def test_what_cannot_be_timed_is_refused(tmp_path):
    with pytest.raises(ValueError, match="parts must be some of stages, em.*got speed"):
        experiments.benchmark.benchmark(benchmark_config("parts=[speed]"), tmp_path)
    with pytest.raises(ValueError, match="4 frames"):
        load(benchmark_config("dataset.stop=3"))
    with pytest.raises(ValueError, match="benchmark.turns is no key"):
        benchmark_config("benchmark.turns=3")


@pytest.mark.long
def test_both_registrations_find_the_pose_of_exact_views():
    config = benchmark_config("prior.level=0", "slam.fit.points_per_gaussian=264", "dataset.num_frames=100")
    for timing in time_icp(load(config), (0.08, 0.04), 1):  # starts 8 cm and 2.3 degrees away
        assert timing.facts["translation_error_cm"][0] < 2.0, timing.name  # pixels are 5 cm apart
        assert timing.facts["rotation_error_deg"][0] < 0.6, timing.name


@pytest.mark.long
def test_drawing_agrees_with_compositing_without_tiles(monkeypatch):
    monkeypatch.setattr(comparisons, "MAX_PAIRS", 200 * 64 * 12)  # a line of four
    ours, dense = time_render(load(benchmark_config("render.tile_capacity=256"), thin=1), 1, 200, 1)[:2]
    assert ours.facts["tile_overflow"] == 0 and ours.facts["color_error_999"] < 1e-3
    assert dense.facts["drawn_lines"] == 12


@pytest.mark.long
def test_a_map_is_enlarged_by_copies_that_no_camera_sees():
    state, _ = first_state(load(benchmark_config()))
    count = int(state.map.gaussians.valid.sum())
    large = enlarged(state.map, 3 * count, 50.0)
    means = np.asarray(large.gaussians.means)[: 3 * count].reshape(3, count, 3)
    offsets = np.arange(3)[:, None, None] * np.broadcast_to([50.0, 0, 0], (1, count, 3))
    np.testing.assert_allclose(means - means[:1], offsets, atol=1e-4)
    assert int(large.gaussians.valid.sum()) == 3 * count and large.weight.shape == (6 * count,)


@pytest.mark.long
def test_the_tables_hold_every_part(tmp_path):
    sizes = ("benchmark.num_settings=[2]", "benchmark.map_sizes=[100,400]", "benchmark.image_sizes=[[64,48]]")
    timings = experiments.benchmark.benchmark(benchmark_config(*sizes, "parts=[stages,sweep,growth]"), tmp_path)
    written(tmp_path, timings)
    names = {timing.name for timing in timings}
    assert {"E-step", "whole step", "2 settings, vmap", "64x48, 400 Gaussians"} <= names
