"""The benchmark; oracles: a clock that is told what to say, and the names of a step's executables."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_run import TINY

import tools.benchmark
from tools.benchmark import in_turns, load, stages


def test_stages_take_turns_and_compilation_is_what_a_first_call_takes_longer(monkeypatch):
    order, clock = [], iter(np.cumsum([0, 20, 0, 5, 0, 40, 0, 5, 0, 80, 0, 5]) / 1e3)
    monkeypatch.setattr(tools.benchmark, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    calls = {name: partial(order.append, name) for name in "ab"}
    lines = list(in_turns(calls, {"a": 2.04, "b": 0.001}, 3))
    assert order == ["a", "b"] * 3
    assert lines == [["a", "2.0", "40 (20–80)"], ["b", "0.0", "5 (5–5)"]]


def test_too_few_frames_are_refused():
    with pytest.raises(ValueError, match="a step needs 4 frames"):
        load(*TINY, "dataset.stop=3")


@pytest.mark.weekly
def test_the_table_has_every_stage_and_the_whole_step():
    table = stages(load(*TINY), 2)
    names = [line[0] for line in table.lines]
    assert {"localize coarse", "select", "localize fine", "fuse", "refine", "store", "whole step"} <= {*names}
    assert all(float(line[2].split()[0]) > 0 for line in table.lines)
