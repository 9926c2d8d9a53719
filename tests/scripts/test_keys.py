"""The commands' own keys: a value of another kind is named with its key, and what conf/ says passes."""

import math
from functools import cache

import pytest
from omegaconf import OmegaConf

from emgs_jax.config.configure import CONF, compose
from experiments.keys import KEYS, check_keys

NEEDED = {
    "evaluate": ["suite=smoke"],
    "embed": ["features=random", "classes=[a,b]", "out=a.npz"],
    "export": ["folder=a"],
    "predict": ["out=a"],
    "segment": ["map=a", "truth=frames"],
    "score": ["trajectory=a", "method=b"],
    "view": ["folder=a"],
}


@cache
def composed(name: str):
    return compose(*NEEDED.get(name, []), name=name)


@pytest.mark.parametrize(
    ("name", "key", "value", "message"),
    [
        ("evaluate", "seeds", 3, "seeds must be a list of whole numbers, each once, got 3"),
        ("evaluate", "seeds", None, "seeds must be a list of whole numbers, each once, got null"),
        ("evaluate", "seeds", [], r"seeds must be a list of whole numbers, each once, got \[\]"),
        ("evaluate", "seeds", [1, 0, 1], r"seeds must be a list of whole numbers, each once, got \[1, 0, 1\]"),
        ("evaluate", "seeds", [True], "seeds must be a list of whole numbers"),
        ("evaluate", "variants", 3, "variants must be NAME: {KEY: VALUE}, one or more, got 3"),
        ("evaluate", "overrides", "abc", "overrides must be a list of KEY=VALUE, got 'abc'"),
        ("evaluate", "overrides", ["abc"], "overrides must be a list of KEY=VALUE"),
        ("export", "formats", 3, "formats must be a list of names, got 3"),
        ("score", "max_time_difference", math.nan, "max_time_difference must be a number from 0 to 1000000, got nan"),
        ("score", "normal_neighbours", 2.5, "normal_neighbours must be a whole number from 3 to 1000, got 2.5"),
        ("score", "min_matched_percent", "many", "min_matched_percent must be a number from 0 to 100, got 'many'"),
        ("segment", "alignment", "guess", "alignment must be one of trajectory, points, got 'guess'"),
        ("segment", "with_scale", 1, "with_scale must be one of True, False, got 1"),
        ("view", "port", True, "port must be a whole number from 1 to 65535, got True"),
        ("view", "port", 0, "port must be a whole number from 1 to 65535, got 0"),
        ("segment", "map", ["a", 3], r"map must be a folder or a list of folders, got \['a', 3\]"),
        ("segment", "map", [], r"map must be a folder or a list of folders, got \[\]"),
        ("predict", "out", None, "out must be text, got null"),
        ("embed", "classes", 3, "classes must be a list of names, got 3"),
    ],
)
def test_a_value_of_another_kind_is_named_with_its_key(name, key, value, message):
    config = composed(name).copy()
    OmegaConf.update(config, key, value)
    with pytest.raises(ValueError, match=message):
        check_keys(name, config)


@pytest.mark.parametrize("name", sorted({*KEYS, *NEEDED, "config"}))
def test_what_conf_says_passes_and_every_key_that_is_checked_is_there(name):
    """An export may be of the scaled copies alone; segment takes one folder or several, which was refused."""
    assert check_keys(name, composed(name)) is None
    own = OmegaConf.load(CONF / f"{name}.yaml")
    for key in KEYS.get(name, ()):
        assert OmegaConf.is_missing(own, key) or OmegaConf.select(own, key, default="absent") != "absent"
    other = {"export": {"scale": 1.07, "formats": []}, "segment": {"map": ["a", "b"]}}.get(name, {})
    assert check_keys(name, OmegaConf.merge(composed(name), other)) is None
