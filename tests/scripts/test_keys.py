"""The commands' own keys: a value of another kind is named with its key, and what conf/ says passes."""

import math

import pytest
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.config.values import check_keys
from emgs_jax.runs.export import ExportConfig
from experiments.keys import KEYS

ALL = KEYS | {"export": ExportConfig}
NEEDED = {
    "evaluate": ["suite=smoke"],
    "embed": ["features=random", "classes=[a,b]", "out=a.npz"],
    "export": ["folder=a", "scale=1.07", "formats=[]"],
    "segment": ["map=[a,b]", "truth=frames"],
    "score": ["trajectory=a", "method=b"],
    "view": ["folder=a"],
}
WRONG = {
    "evaluate": {"seeds": [3, None, [True], [-1]], "overrides": ["abc"], "shard": [3]},
    "export": {"formats": [3], "moving": ["gone"], "length": ["a"]},
    "score": {"max_time_difference": [math.nan], "normal_neighbours": [2.5, 2], "min_matched_percent": ["many"]},
    "segment": {"alignment": ["guess"], "with_scale": [1], "map": [["a", 3], 3]},
    "query": {"margin": [3], "frame": [-1], "num_views": [0]},
    "view": {"port": [True, 0], "folder": [3]},
    "embed": {"classes": [3], "out": [3]},
}


@pytest.mark.parametrize("name", sorted(ALL))
def test_a_value_of_another_kind_is_named_with_its_key_and_what_conf_says_passes(name):
    config = compose(*NEEDED.get(name, []), name=name)
    check_keys(config, ALL[name])
    for key, values in WRONG[name].items():
        for value in values:
            other = config.copy()
            OmegaConf.update(other, key, value)
            with pytest.raises(ValueError, match=rf"^{key} must be "):
                check_keys(other, ALL[name])
