"""Effect of each value of a sweep: `python -m experiments.effects folder=multirun/sweep`.

Every setting that differs in one key from the sweep's own config is compared with that config, on the same predictions.
The differences are averaged over the repetitions (seeds) that are found below the folder.
"""

import copy
import json
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from emgs_jax.report.columns import MAIN, Column, Table, cell, in_unit, markdown
from emgs_jax.report.sweeps import read_sweep

from .command import command


@dataclass(frozen=True)
class Effect:
    """One changed value, or (key None) the unchanged config with the metrics themselves.

    Args:
        key: that differs from the config; None for the config itself.
        own: the config's value.
        metrics: metric -> difference from the config, one for each repetition that has both.
    """

    data: str
    key: str | None
    value: Any
    own: Any
    metrics: dict[str, list[float]]


def read_effects(folder: str | Path, repetitions: Sequence[str]) -> list[Effect]:
    """Effects of all sweeps below a folder.

    Raises:
        ValueError: there is none, one is there twice, or one lacks its own config.
    """
    paths = sorted(Path(folder).rglob("sweep.json"))
    if not paths:
        raise ValueError(f"there is no sweep.json below {folder}: make some with experiments.sweep -m prior.seed=0,1,2")
    groups: dict[tuple[str, str], dict[tuple, Effect]] = defaultdict(dict)
    repeated: dict[tuple[str, str], Path] = {}
    for path in paths:
        sweep = read_sweep(path)
        title = _described(sweep)
        other = repeated.setdefault((title, _identity(sweep, ())), path)
        if other != path:
            raise ValueError(f"{path} is the same sweep as {other}, and would count as one more: move one of them away")
        _add(groups[title, _identity(sweep, repetitions)], title, sweep, path)
    titles, effects = [title for title, _ in groups], []
    for number, ((title, _), found) in enumerate(groups.items()):
        if titles.count(title) > 1:  # the same data with another config, which no table must mix
            title = f"{title}, config {number}"
        ordered = sorted(found.values(), key=lambda effect: effect.key is not None)  # the config itself first
        effects += [replace(effect, data=title) for effect in ordered]
    return effects


def _described(sweep: Mapping[str, Any]) -> str:
    data, prior = sweep["provenance"]["data"], sweep["provenance"]["prior"]
    level = f" {prior['settings']['level']:g}" if "level" in prior["settings"] else ""
    return f"{data['name']} {data['sequence']}, prior {prior['name']}{level}"


def _identity(sweep: Mapping[str, Any], repetitions: Sequence[str]) -> str:
    """The code, and the config without what may differ between repetitions."""
    code = [sweep["provenance"].get(key) for key in ("git", "versions")]
    config = copy.deepcopy(sweep["provenance"]["config"])
    for key in repetitions:
        *nodes, name = key.split(".")
        reduce(lambda node, name: node.get(name, {}), nodes, config).pop(name, None)
    return json.dumps([code, config], sort_keys=True)


def _add(effects: dict[tuple, Effect], title: str, sweep: Mapping[str, Any], path: Path) -> None:
    """Add the metrics of a sweep's own config, and what differs from them in every setting with one changed value."""
    config, settings = sweep["provenance"]["config"], sweep["settings"]
    found = {key: reduce(dict.get, key.split("."), config) for key in settings[0]["setting"]}
    # JSON has no infinity: a setting says it in words, a config has null.
    own = {key: "inf" if value is None else value for key, value in found.items()}
    base = next((row["metrics"] for row in settings if row["setting"] == own), None)
    if base is None:
        raise ValueError(f"{path} lacks its own config's values {own}: add them to the axes, or grid=one_at_a_time")
    for row in settings:
        changed = [key for key, value in row["setting"].items() if value != own[key]]
        if len(changed) > 1:
            continue
        key, value, before = (changed[0], row["setting"][changed[0]], own[changed[0]]) if changed else (None,) * 3
        effect = effects.setdefault((key, value), Effect(title, key, value, before, defaultdict(list)))
        for name, number in row["metrics"].items():
            if isinstance(number, int | float) and isinstance(base.get(name), int | float):
                effect.metrics[name].append(number - base[name] if changed else number)


def spread(numbers: Sequence[float], factor: float, digits: int, is_difference: bool) -> str:
    """Mean ± standard deviation; a mean of differences is bold where all of at least three have its sign."""
    mean = statistics.fmean(numbers) if numbers else None
    deviation = statistics.stdev(numbers) if len(numbers) > 1 else None
    text = cell(mean, deviation, factor, digits, "+" if is_difference else "")
    agree = len(numbers) > 2 and (min(numbers) > 0 or max(numbers) < 0)
    return f"**{text}**" if is_difference and agree else text


def columns(alignment: str) -> list[Column]:
    """`MAIN` as the sweep's protocol aligns, or with the metrics after an SE(3) alignment in their place."""
    if alignment == "protocol":
        return list(MAIN)
    names = {"trajectory/ate_sim3_m": "trajectory/ate_se3_m"}
    other = {key: names.get(key, key.replace("reconstruction/", "reconstruction_se3/")) for key, *_ in MAIN}
    return [column._replace(key=other[column.key]) for column in MAIN]


def table(effects: Sequence[Effect], alignment: str = "protocol") -> str:
    """Markdown: for each sequence the metrics of its config, then what each changed value adds to them."""
    shown, lines = in_unit(columns(alignment), {effect.data.split()[0] for effect in effects}), []
    for effect in effects:
        change = "unchanged" if effect.key is None else f"{effect.key}={effect.value} (from {effect.own})"
        runs = max(map(len, effect.metrics.values()), default=0)
        numbers = [(effect.metrics.get(key, []), factor, digits) for key, _, factor, digits, _ in shown]
        lines.append([effect.data, change, str(runs), *(spread(*entry, effect.key is not None) for entry in numbers)])
    return markdown(Table(["data", "change", "runs", *(column.title for column in shown)], lines))


@command("effects")
def main(config: DictConfig) -> None:
    """Print the table."""
    print(table(read_effects(config.folder, config.repetitions), config.align))


if __name__ == "__main__":
    main()
