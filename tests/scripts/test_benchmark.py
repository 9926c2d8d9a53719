"""The benchmark; oracles: a clock that is told what to say, and the names of a step's executables."""

import pytest
from tiny_run import TINY

from tools.benchmark import load, stages


@pytest.mark.weekly
def test_the_table_has_every_stage_and_the_whole_step():
    table = stages(load(*TINY), 2)
    names = [line[0] for line in table.lines]
    assert {"localize coarse", "select", "localize fine", "fuse", "refine", "store", "whole step"} <= {*names}
    assert all(float(line[2].split()[0]) > 0 for line in table.lines)
