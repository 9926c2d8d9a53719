"""The benchmark; oracles: true poses, a clock that is told what to say, and the files."""

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_run import compose

import experiments.benchmark
from experiments.benchmark_icp import time_icp
from experiments.timing import Candidate, compare, interleaved, load, spread


def benchmark_config(*overrides: str):
    return compose("prior.level=0.3", "benchmark.repetitions=2", *overrides, name="benchmark")


def test_candidates_take_turns_and_a_ratio_compares_the_same_turn(monkeypatch):
    order, clock = [], iter(np.cumsum([0, 5, 0, 1, 0, 20, 0, 5, 0, 40, 0, 5, 0, 80, 0, 5]) / 1e3)
    monkeypatch.setattr("experiments.timing.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    timings = compare(interleaved("part", {name: Candidate(partial(order.append, name)) for name in "ab"}, 3), "a")
    assert order == ["a", "b"] * 4  # the first turn does not count
    np.testing.assert_allclose(timings[0].seconds, [0.02, 0.04, 0.08])
    np.testing.assert_allclose(timings[1].facts["times_faster_than"]["a"], (8, 4, 16))
    assert spread([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)


def test_what_cannot_be_timed_is_refused(tmp_path):
    with pytest.raises(ValueError, match="parts must be some of stages, icp.*got speed"):
        experiments.benchmark.benchmark(benchmark_config("parts=[speed]"), tmp_path)
    with pytest.raises(ValueError, match="4 frames"):
        load(benchmark_config("dataset.stop=3"))
    with pytest.raises(ValueError, match="benchmark.turns is no key"):
        benchmark_config("benchmark.turns=3")


@pytest.mark.weekly
def test_both_registrations_find_the_pose_of_exact_views():
    config = benchmark_config("prior.level=0", "slam.fit.points_per_gaussian=264", "dataset.num_frames=100")
    for timing in time_icp(load(config), (0.08, 0.04), 1):  # starts 8 cm and 2.3 degrees away
        assert timing.facts["translation_error_cm"][0] < 2.0, timing.name  # pixels are 5 cm apart
        assert timing.facts["rotation_error_deg"][0] < 0.6, timing.name


@pytest.mark.weekly
def test_the_tables_hold_every_part(tmp_path):
    config = benchmark_config("benchmark.num_settings=[2]", "parts=[stages,sweep]")
    timings = experiments.benchmark.benchmark(config, tmp_path)
    about, text = json.loads((tmp_path / "benchmark.json").read_text()), (tmp_path / "benchmark.md").read_text()
    names = [timing.name for timing in timings]
    assert {"localize fine", "fuse", "whole step", "2 settings, vmap"} <= {*names}
    assert [row["name"] for row in about["timings"]] == names and all(f"| {name} |" in text for name in names)
    assert about["provenance"]["device"]["kind"] in text
    assert all(len(timing.seconds) == 2 and min(timing.seconds) > 0 for timing in timings)
