"""Stages that are replaced through the public hook: the listing of docs/change_a_stage.md, and each name by itself."""

import jax
import jax.numpy as jnp
import pytest
from scene import CONF
from test_docs import BLOCK
from tiny_run import TINY

import emgs_jax
from emgs_jax import sequence
from emgs_jax.slam import Stages

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]


def test_the_listing_compares_a_stage_with_its_replacement(monkeypatch):
    page = (CONF.parent / "docs" / "change_a_stage.md").read_text()
    listing = next(block for block in BLOCK.findall(page) if "e_step=hard" in block)
    load, found = sequence.load_config, {}
    monkeypatch.setattr("emgs_jax.load_config", lambda *_: load(*TINY))
    exec(listing, found)  # noqa: S102
    a, b = ([record.fused for record in found[name].records if record.fused] for name in "ab")
    updated = [sum(record.updated or 0 for record in found[name].records) for name in "ab"]
    assert a and b and updated[1] < updated[0]
    again = emgs_jax.map_sequence(found["config"], show_progress=False)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, again.map, found["a"].map)), "nobody else gets it"


def test_a_name_that_is_no_stage_is_refused():
    with pytest.raises(ValueError, match="em_updat"):
        emgs_jax.map_sequence(emgs_jax.load_config(*TINY), em_updat=print)


def test_each_stage_of_the_list_is_the_one_that_runs():
    """Each is replaced by itself with a note beside it, all in one run; `find_movers` runs where things may move."""
    called = set()

    def noted(name, function):
        def stage(*given):
            called.add(name)
            return function(*given)

        return stage

    stages = {name: noted(name, function) for name, function in Stages()._asdict().items()}
    config = emgs_jax.load_config(*TINY, "slam/motion=default")
    emgs_jax.map_sequence(config, show_progress=False, **stages)
    assert called == set(Stages._fields)
