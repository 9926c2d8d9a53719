"""The command that repeats a run: the words that compose its config from conf/."""

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import CONF, compose
from emgs_jax.config.overrides import written
from emgs_jax.config.schema import SCHEMAS, schema_of
from emgs_jax.config.values import field_of
from emgs_jax.io.files import flat, jsonable

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # in C if available: a report reads seventy files


class Repeated(NamedTuple):
    """Overrides of `emgs run` that repeat a run."""

    words: list[str]  # that compose its config, groups first; with + for a key that conf/ no longer has
    differences: list[tuple[str, Any, Any]]  # key, value and default of each; ... for a missing default

    @property
    def command(self) -> str:
        """Write the line for a shell."""
        return shlex.join(["emgs", "run", *self.words])


def repeat(settings: Mapping[str, Any]) -> Repeated:
    """Find the overrides that repeat the run with these settings, the `config` of a provenance."""
    settings = flat(jsonable(settings))
    options = _options(settings)
    words = [f"{group}={option}" for group, option, _ in options]
    differences: list[tuple[str, Any, Any]] = list(options)
    config, made = compose(*words), len(words)
    for follows_another in (False, True):  # values taken from another key follow it
        if len(words) > made:
            config = compose(*words)
        composed = flat(jsonable(OmegaConf.to_container(config, resolve=True)))
        own = flat(OmegaConf.to_container(config, resolve=False))
        for key, value in settings.items():
            default = composed.get(key, ...)
            if default != value and (follows_another or not str(own.get(key, "${")).startswith("${")):
                is_known = OmegaConf.select(config, key, default=...) is not ...
                value = _infinity(config, key) if is_known and value is None else value
                words.append(f"{'' if is_known else '+'}{key}={written(value)}")
                differences.append((key, value, default))
    return Repeated(words, differences)


def _infinity(config: DictConfig, key: str) -> float | None:
    """Return the infinity that null stands for in JSON: that of an option of conf/, or an end of the range.

    None if the key itself takes null.
    """
    group, _, name = key.rpartition(".")
    node = OmegaConf.select(config, group) if group else None
    field = field_of(config, key) if isinstance(node, DictConfig) and "_target_" in node else None
    if field is None or field.range is None or type(None) in field.kinds:
        return None
    options = (_content(path).get(name) for path in (CONF / group.replace(".", "/")).glob("*.yaml"))
    given = [value for value in options if isinstance(value, float) and math.isinf(value)]
    return next((end for end in (*given, field.range.high, field.range.low) if math.isinf(end)), None)


def _options(settings: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """List group, option and default of every group with an option nearer to the flat settings than the default."""
    found = []
    for group, default in _default_options().items():
        start = f"{group.replace('/', '.')}."
        wanted = {key.removeprefix(start): value for key, value in settings.items() if key.startswith(start)}
        options = {path.stem: jsonable(_content(path)) for path in sorted((CONF / group).glob("*.yaml"))}
        gaps = {
            name: sum(made.get(k, ...) != wanted.get(k, ...) for k in {*made, *wanted})
            for name, made in options.items()
        }
        best = min(gaps, key=lambda name: (gaps[name], name != default))
        if best != default:
            found.append((group, best, default))
    return found


def _default_options() -> dict[str, str]:
    """Return the option of every group that conf/config.yaml names."""
    lines = [line for line in _read(CONF / "config.yaml")["defaults"] if isinstance(line, dict)]
    named = {group: option for line in lines for group, option in line.items()}
    return {group: option for group, option in named.items() if option and (CONF / group).is_dir()}


def _content(path: Path) -> dict[str, Any]:
    """Read values by dotted key from a file of conf/, including those that it inherits."""
    node, found = _read(path), {}
    for name, _, place in (str(line).partition("@") for line in node.pop("defaults", [])):
        parent, schema = path.parent / f"{name}.yaml", f"{path.parent.relative_to(CONF).as_posix()}/{name}"
        inherited = _content(parent) if parent.is_file() else flat(schema_of(schema)) if schema in SCHEMAS else {}
        found |= {f"{place}.{key}" if place else key: value for key, value in inherited.items()}
    return found | flat(node)


def _read(path: Path) -> dict[str, Any]:
    return yaml.load(path.read_text(encoding="utf-8"), _LOADER) or {}


def check_targets(settings: Any) -> None:
    """Raise ValueError if settings name a class that conf/ does not, because a foreign file must not choose code."""
    trees = [{"": settings}, *map(_read, CONF.rglob("*.yaml")), *map(schema_of, SCHEMAS)]
    named, *known = ({v for key, v in flat(tree).items() if key.endswith("_target_")} for tree in trees)
    if unknown := named.difference(*known):
        raise ValueError(f"metrics.json names {sorted(map(str, unknown))}, which no file of conf/ does: run again")
