"""Results of a search: a table of the default and the best on every sequence, a picture, settings that `run` takes."""

import os
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import yaml
from matplotlib.figure import Figure

from emgs_jax.report.colors import save_figure
from emgs_jax.report.columns import MAIN, PLACED, RENDERED, Column, Line, in_unit, markdown, metric_table
from emgs_jax.report.provenance import RAW_PRIOR

DEFAULT, RAW = "default", "raw prior"


@dataclass(frozen=True)
class SequenceResults:
    """Metrics of the settings of a search on one sequence."""

    name: str
    data: str  # name of its data set
    is_held_out: bool
    is_simulated: bool
    metrics: Mapping[str, Mapping[str, Any]]  # of DEFAULT and of trials, by name


def columns_of(objectives: Mapping[str, str]) -> list[Column]:
    """Return columns of the objectives (metric -> `minimize` or `maximize`), then of the other main metrics."""
    known = {column.key: column for column in (*MAIN, *PLACED, *RENDERED)}
    own = [known.get(key, Column(key, key, 1.0, 4, direction == "minimize")) for key, direction in objectives.items()]
    return own + [column for column in MAIN if column.key not in objectives]


def table(results: Sequence[SequenceResults], objectives: Mapping[str, str]) -> str:
    """Write the raw prior, the default and the best on each tuned sequence, then on each that was held out (Markdown).

    Of several sequences of a kind there are means, too, of what all of them have. The best of ours is bold.
    """
    columns, lines = columns_of(objectives), []
    for is_held_out, kind in ((False, "tuned"), (True, "**held out**")):
        some = [result for result in results if result.is_held_out == is_held_out]
        blocks = [(result.name + ", simulated" * result.is_simulated, _rows(result, columns)) for result in some]
        if len(some) > 1:
            blocks.append((f"mean of {len(some)}", _means([rows for _, rows in blocks], columns)))
        for name, rows in blocks:
            for setting, values in rows.items():
                rivals = None if setting == RAW else (kind, name)
                lines.append(Line([kind, name, setting], values, rivals=rivals))
    return markdown(metric_table(["", "sequence", "setting"], columns, lines, {result.data for result in results}))


Rows = Mapping[str, Mapping[str, Any]]  # metrics by setting


def _rows(result: SequenceResults, columns: Sequence[Column]) -> Rows:
    first = next(iter(result.metrics.values()))
    raw = {column.key: first.get(RAW_PRIOR + column.key) for column in columns}
    return ({RAW: raw} if any(value is not None for value in raw.values()) else {}) | dict(result.metrics)


def _means(blocks: Sequence[Rows], columns: Sequence[Column]) -> Rows:
    names = [name for name in blocks[0] if all(name in rows for rows in blocks)]
    return {name: {c.key: _mean([rows[name].get(c.key) for rows in blocks]) for c in columns} for name in names}


def _mean(values: Sequence[float | None]) -> float | None:
    return None if None in values else statistics.fmean(values)


def verdict(results: Sequence[SequenceResults], objectives: Mapping[str, str]) -> dict[str, str]:
    """Say in one line for each trial that was held out how its objectives differ from the default's there."""
    held_out = [result.metrics for result in results if result.is_held_out]
    lines = {}
    for trial in held_out[0] if held_out else ():
        if trial != DEFAULT:
            parts = [_compared(held_out, trial, *objective) for objective in objectives.items()]
            lines[trial] = f"held out, {trial} against the default: {'; '.join(parts)}"
    return lines


def _compared(held_out: Sequence[Mapping[str, Mapping[str, Any]]], trial: str, key: str, direction: str) -> str:
    pairs = [(metrics[DEFAULT].get(key), metrics[trial].get(key)) for metrics in held_out]
    known = [pair for pair in pairs if None not in pair]
    if not known:
        return f"{key} has no value"
    sign = 1 if direction == "minimize" else -1
    better = sum(sign * (after - before) < 0 for before, after in known)
    before, after = (statistics.fmean(numbers) for numbers in zip(*known, strict=True))
    return f"{key} {before:.4g} → {after:.4g}, better on {better} of {len(pairs)}"


def settings_yaml(setting: Mapping[str, Any], lines: Sequence[str]) -> str:
    """Write a setting as an option of Hydra that changes keys wherever they stand, below comments."""
    tree: dict[str, Any] = {}
    for key, value in setting.items():
        *parents, name = key.split(".")
        reduce(lambda node, parent: node.setdefault(parent, {}), parents, tree)[name] = value
    comments = "".join(f"# {line}\n" for line in ("@package _global_", *lines))
    return comments + yaml.safe_dump(tree, sort_keys=False)


def draw_trials(
    path: str | os.PathLike,
    rows: Sequence[Mapping[str, Any]],
    objectives: Mapping[str, str],
    named: Mapping[int, str],
    title: str,
    data: Collection[str],
) -> str | None:
    """Draw the first objective over the second, or over the trials where there is but one, and write it as PNG.

    Returns None, or why there is no picture.

    Args:
        rows: of trials: `trial`, its number, and the objectives, which may be None.
        objectives: metric -> direction.
        named: words of the trials that are marked, by their number.
        data: names of the data sets.
    """
    shown = in_unit(columns_of(objectives)[: min(len(objectives), 2)], data)
    known = [row for row in rows if all(row.get(column.key) is not None for column in shown)]
    if not known:
        return "no trial has all objectives"
    y, *others = [[column.factor * row[column.key] for row in known] for column in shown]
    x = others[0] if others else [row["trial"] for row in known]
    figure = Figure(figsize=(6.4, 4.8), facecolor="white", layout="constrained")
    axes = figure.subplots()
    axes.scatter(x, y, c=["#e4572e" if row["trial"] in named else "#9aa5b1" for row in known], s=28)
    for row, across, up in zip(known, x, y, strict=True):
        words = named.get(row["trial"], "")
        axes.annotate(words, (across, up), textcoords="offset points", xytext=(5, 4), fontsize=8)
    axes.set_ylabel(shown[0].title)
    axes.set_xlabel(shown[1].title if len(shown) > 1 else "trial")
    axes.set_title(title, fontsize=10)
    save_figure(path, figure)
    return None
