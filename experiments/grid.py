"""The axes of a sweep: dotted keys of the config with their values, checked, and the configs of their grid."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import build, keys_of, near
from emgs_jax.mapping.batch import programs
from emgs_jax.render.densify import DensifyConfig
from emgs_jax.slam import SlamConfig

Value = float | int | str | bool
Axes = Mapping[str, Sequence[Value]]
GRIDS = ("product", "one_at_a_time")


@dataclass(frozen=True)
class Variant:
    """One point of the grid.

    Args:
        setting: key -> value; infinities as text, as JSON has none.
        densify: what is drawn is shared with the refinement.
    """

    setting: dict[str, Value]
    slam: SlamConfig
    densify: DensifyConfig


def read_axes(config: DictConfig) -> dict[str, list[Value]]:
    """The axes of a composed config; raises ValueError where one is no key of a stage or has no list of values."""
    known = stage_keys(config)
    axes = OmegaConf.to_container(config)["axes"]
    if not axes:
        raise ValueError("the sweep has no axis: choose one with sweep=gates or 'axes={slam.em.normal_weight:[0,5]}'")
    if config.grid not in GRIDS:
        raise ValueError(f"grid must be one of {', '.join(GRIDS)}, got {config.grid!r}")
    for key, values in axes.items():
        if key not in known:
            raise ValueError(f"axis {key} is no key of a stage; {_advice(key, known)}")
        if not isinstance(values, list) or not values:
            raise ValueError(f"axis {key} must be a list of values, got {values!r}: write {key}: [{values}, …]")
        if any(not isinstance(value, Value) for value in values):
            raise ValueError(f"axis {key} must have numbers or names as values, got {values!r}")
    return {key: list(dict.fromkeys(values)) for key, values in axes.items()}


def stage_keys(config: DictConfig) -> list[str]:
    """Dotted keys of the values of all stages and of the rendering that they share, sorted."""
    keys = (key for key in keys_of(config) if key.startswith(("slam.", "render.")) and "._" not in key)
    return sorted(key for key in keys if not isinstance(OmegaConf.select(config, key), DictConfig))


def _advice(key: str, known: list[str]) -> str:
    if key.split(".")[0] in ("dataset", "prior"):
        return f"a sweep predicts once, so sweep it around: experiments.sweep -m {key}=…,… or experiments.run -m"
    return near(key, known)


def variants(config: DictConfig, axes: Axes) -> list[Variant]:
    """The settings of `config.grid`, the last axis fastest; raises ValueError where a value is refused.

    These are every combination of the axes' values, or the config's own values and then each other value by itself.
    """
    if config.grid == "product":
        settings = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    else:
        own = {key: OmegaConf.select(config, key) for key in axes}
        others = [(key, value) for key, values in axes.items() for value in values if value != own[key]]
        settings = [own, *(own | {key: value} for key, value in others)]
    return [variant_of(config, setting) for setting in settings]


def variant_of(config: DictConfig, setting: Mapping[str, Value]) -> Variant:
    """The config with the values of one setting; raises ValueError where one is refused."""
    changed = config.copy()
    for key, value in setting.items():
        OmegaConf.update(changed, key, value)
    return Variant(plain_setting(setting), build(changed, "slam"), build(changed, "densify"))


def plain_setting(setting: Mapping[str, Value]) -> dict[str, Value]:
    """A setting as results have it: infinities as text, as JSON has none."""
    return {key: str(v) if isinstance(v, float) and not math.isfinite(v) else v for key, v in setting.items()}


def notes(config: DictConfig, axes: Axes) -> list[str]:
    """List axes whose values do not share a compiled program, or need predictions of their own, in a sentence each."""
    found = []
    for key, values in axes.items():
        configs = [variant.slam for variant in variants(config, {key: values})]
        if len(set(map(jax.tree.structure, configs))) > 1:
            found.append(f"{key} is static: it compiles once for each of its {len(values)} values")
        elif len(programs(configs)) > 1:
            found.append(f"{key} decides what a prediction becomes: its {len(values)} values are mapped in turn")
    return found
