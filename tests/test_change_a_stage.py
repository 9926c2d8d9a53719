"""The listing of docs/change_a_stage.md: a stage that is replaced between two runs of one process."""

import pytest
from scene import CONF
from test_docs import BLOCK
from tiny_run import TINY

from emgs_jax import em, sequence

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]


def test_the_listing_compares_a_stage_with_its_replacement(monkeypatch):
    page = (CONF.parent / "docs" / "change_a_stage.md").read_text()
    listing = next(block for block in BLOCK.findall(page) if "em._explain = hard" in block)
    load, before, found = sequence.load_config, em._explain, {}
    monkeypatch.setattr("emgs_jax.load_config", lambda *_: load(*TINY))
    exec(listing, found)  # noqa: S102
    a, b = ([record.fused for record in found[name].records if record.fused] for name in "ab")
    updated = [sum(record.updated or 0 for record in found[name].records) for name in "ab"]
    assert em._explain is before and a and b and updated[1] < updated[0]
