"""The keys of the commands themselves, which are no parameter of a class: of what kind each is."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import CONF


class Kind(NamedTuple):
    """Kind of a value, in words and as a check."""

    words: str
    fits: Callable[[Any], bool]


def whole(low: int, high: float = math.inf, or_null: bool = False) -> Kind:
    """A whole number from `low` to `high`."""
    end = "on" if high == math.inf else f"to {high}"
    fits = lambda value: (or_null and value is None) or (_is(value, int) and low <= value <= high)  # noqa: E731
    return Kind(f"a whole number from {low} {end}{' or null' * or_null}", fits)


def number(low: float, high: float) -> Kind:
    """A number from `low` to `high`; nan is none."""
    return Kind(f"a number from {low} to {high}", lambda value: _is(value, int | float) and low <= value <= high)


def one_of(*values: Any) -> Kind:
    """One of these, of the same type: true is not 1."""
    allowed = [(type(value), value) for value in values]
    return Kind(f"one of {', '.join(map(str, values))}", lambda value: (type(value), value) in allowed)


def some(words: str, fits: Callable[[Any], bool], least: int = 1) -> Kind:
    """A list of `least` or more."""
    return Kind(f"a list of {words}", lambda value: _is_list(value) and len(value) >= least and all(map(fits, value)))


def _is(value: Any, kind: Any) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_once(values: Any) -> bool:
    return SEEDS.fits(values) and len(set(values)) == len(values)


TEXT, COUNT = Kind("text", _is_text), whole(1)
SEEDS, NAMES = some("whole numbers", lambda value: _is(value, int) and value >= 0), some("names", _is_text)
KEYS: dict[str, dict[str, Kind]] = {
    "evaluate": {
        "seeds": Kind(f"{SEEDS.words}, each once", _is_once),
        "overrides": some("KEY=VALUE", lambda value: _is_text(value) and "=" in value, least=0),
        "variants": Kind(
            "NAME: {KEY: VALUE}, one or more", lambda value: isinstance(value, Mapping) and len(value) > 0
        ),
        "shard": TEXT,
    },
    "export": {"formats": some("names", _is_text, least=0)},  # the others are those of ExportConfig
    "embed": {"classes": NAMES},
    "segment": {
        "map": Kind("a folder or a list of folders", lambda value: _is_text(value) or NAMES.fits(value)),
        "alignment": one_of("trajectory", "points"),
        "with_scale": one_of(True, False),
        "icp_distance_m": number(1e-6, 1000000),
        "icp_max_steps": whole(0, 10000),
        "voxel_m": number(1e-6, 1000000),
        "max_depth_m": number(1e-6, math.inf),
    },
    "query": {
        "margin": number(0, 2),
        "min_cosine": number(-1, 1),
        "num_views": whole(1, 100),
        "max_words": whole(1, 1000),
        "frame": whole(0, or_null=True),
    },
    "score": {
        "max_time_difference": number(0, 1000000),
        "min_associated_percent": number(0, 100),
        "min_matched_percent": number(0, 100),
        "normal_neighbours": whole(3, 1000),
    },
    "view": {"port": whole(1, 65535)},
}
FOLDERS = ("out", "folder", "map", "root")  # of commands, where they have to be given


def check_keys(name: str, config: DictConfig) -> None:
    """Raise ValueError with the key where a value of conf/`name`.yaml's own keys is of another kind."""
    own = OmegaConf.load(CONF / f"{name}.yaml")
    kinds = {key: TEXT for key in FOLDERS if OmegaConf.is_missing(own, key)} | KEYS.get(name, {})
    for key, kind in kinds.items():
        value = OmegaConf.select(config, key)
        value = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
        if not kind.fits(value) and not (value is None and OmegaConf.is_missing(config, key)):
            shown = "null" if value is None else repr(value)
            raise ValueError(f"{key} must be {kind.words}, got {shown}: give such a value")
