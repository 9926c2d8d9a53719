"""The keys of the commands themselves, which are no parameter of a class: of what kind each is."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import CONF
from emgs_jax.config.values import Declared, check_value
from emgs_jax.ops.ranges import Range


class Kind(NamedTuple):
    """Kind of a value, in words and as a check."""

    words: str
    fits: Callable[[Any], bool]


def whole(low: int, or_null: bool = False) -> Kind:
    """A whole number from `low` on."""
    words = f"a whole number from {low} on{' or null' * or_null}"
    return Kind(words, lambda value: (or_null and value is None) or _is_whole(value, low))


def ranged(low: float, high: float, kind: type = float, or_null: bool = False) -> Declared:
    """A number from `low` to `high`."""
    return Declared(frozenset({kind, type(None)} if or_null else {kind}), range=Range(low, high))


def some(words: str, fits: Callable[[Any], bool]) -> Kind:
    """A list, which may be empty."""
    return Kind(f"a list of {words}", lambda value: _is_list(value) and all(map(fits, value)))


def many(words: str, fits: Callable[[Any], bool]) -> Kind:
    """A list of one or more."""
    kind = some(words, fits)
    return Kind(kind.words, lambda value: kind.fits(value) and len(value) > 0)


def _is_whole(value: Any, low: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= low


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_change(value: Any) -> bool:
    return _is_text(value) and "=" in value


TEXT = Kind("text", _is_text)
COUNTS = many("whole numbers from 1 on", lambda value: _is_whole(value, 1))
OFFSET = Kind(
    "[m,rad]",
    lambda value: (
        _is_list(value) and len(value) == 2 and all(isinstance(v, int | float) and math.isfinite(v) for v in value)
    ),
)
SEEDS = many("whole numbers", lambda value: _is_whole(value, 0))
NAMES = many("names", _is_text)
AT_ONCE = {"at_once": whole(1, or_null=True)}
KEYS: dict[str, dict[str, Kind | Declared]] = {
    "sweep": AT_ONCE | {"chunk": whole(1)},
    "tune": AT_ONCE
    | dict.fromkeys(("trials", "chunk", "best"), whole(1))
    | {"startup": whole(0), "search_seed": whole(0)},
    "evaluate": {
        "seeds": Kind(f"{SEEDS.words}, each once", lambda value: SEEDS.fits(value) and len(set(value)) == len(value)),
        "overrides": some("KEY=VALUE", _is_change),
        "variants": Kind(
            "NAME: {KEY: VALUE}, one or more", lambda value: isinstance(value, Mapping) and len(value) > 0
        ),
        "shard": TEXT,
    },
    "export": {"formats": some("names", _is_text)},  # the others are those of ExportConfig
    "effects": {"repetitions": some("keys", _is_text)},
    "embed": {"classes": NAMES},
    "segment": {
        "map": Kind("a folder or a list of folders", lambda value: _is_text(value) or NAMES.fits(value)),
        "alignment": Declared(frozenset({str}), choices=("trajectory", "points")),
        "with_scale": Declared(frozenset({bool})),
        "icp_distance_m": ranged(1e-6, 1e6),
        "icp_max_steps": ranged(0, 10000, int),
        "voxel_m": ranged(1e-6, 1e6),
        "max_depth_m": ranged(1e-6, math.inf),
    },
    "query": {
        "margin": ranged(0, 2),
        "min_cosine": ranged(-1, 1),
        "num_views": ranged(1, 100, int),
        "max_words": ranged(1, 1000, int),
        "frame": ranged(0, 10**9, int, or_null=True),
    },
    "score": {
        "max_time_difference": ranged(0, 1e6),
        "min_associated_percent": ranged(0, 100),
        "min_matched_percent": ranged(0, 100),
        "normal_neighbours": ranged(3, 1000, int),
    },
    "view": {"port": ranged(1, 65535, int)},
    "benchmark": {
        "parts": NAMES,
        "benchmark.repetitions": whole(1),
        "benchmark.num_settings": COUNTS,
        "benchmark.icp_offset": OFFSET,
    },
}
FOLDERS = ("out", "folder", "map", "root")  # of commands, where they have to be given


def check_keys(name: str, config: DictConfig) -> None:
    """Raise ValueError with the key where a value of conf/`name`.yaml's own keys is of another kind."""
    own = OmegaConf.load(CONF / f"{name}.yaml")
    kinds = {key: TEXT for key in FOLDERS if OmegaConf.is_missing(own, key)} | KEYS.get(name, {})
    for key, kind in kinds.items():
        value = OmegaConf.select(config, key)
        if OmegaConf.is_config(value):
            value = OmegaConf.to_container(value)
        if isinstance(kind, Declared):
            check_value(key, value, kind)
        elif not kind.fits(value) and not (value is None and OmegaConf.is_missing(config, key)):
            shown = "null" if value is None else repr(value)
            raise ValueError(f"{key} must be {kind.words}, got {shown}: give such a value")
