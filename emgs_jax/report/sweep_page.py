"""report.html of a sweep: every setting with its metrics and a small picture of its map, beside the prior alone."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emgs_jax.config.overrides import written
from emgs_jax.report.columns import MAIN, Column, Line, Table, known, metric_table
from emgs_jax.report.evaluation_page import run_facts
from emgs_jax.report.html import MAX_LINES, Head, commit_words, page, picture, thumbnails, write_page
from emgs_jax.report.provenance import RAW_PRIOR, in_unit
from emgs_jax.report.repeat import repeat
from emgs_jax.report.sweeps import picture_path

Rows = Sequence[Mapping[str, Any]]


def write_sweep_page(folder: Path, block: Mapping[str, Any], rows: Rows, axes: Sequence[str], command: str) -> Path:
    """Write report.html into the folder of a sweep.

    Args:
        folder: of the sweep, with heat_map.png and pictures where there are any.
        rows: a flat row for each setting, at least one.
        command: that repeats the sweep; "" where nobody knows.
    """
    name, prior = str(block["data"]["name"]), str(block["prior"]["name"])
    columns = in_unit(known(MAIN, [Line((), row) for row in rows]), [name])
    title, words = f"{name} {block['data']['sequence']}", _best_words(rows, axes, columns)
    about = f"Protocol {block['protocol']}; {commit_words(block.get('git'))}, on {block['device']['kind']}"
    names = f"{title}: sweep", f"Sweep: {title}", f"prior {prior}"
    head = Head(*names, "unknown", words, block["simulated"], [about], command, [(name, prior)])
    (heat_map,) = thumbnails([folder / "heat_map.png"], (1300,))
    values = {
        "heat_map": picture(heat_map, "metrics over two axes"),
        "settings": _settings(folder, rows[:MAX_LINES], axes, columns),
        "more": f"sweep.csv has {len(rows) - MAX_LINES} more settings." if len(rows) > MAX_LINES else "",
        "command": _as_run(block, _best(rows, columns[0]) if columns else rows[0], axes),
    }
    return write_page(folder, page("sweep.html", head, **values))


def _best(rows: Rows, column: Column) -> Mapping[str, Any]:
    some = [row for row in rows if row.get(column.key) is not None]
    return (min if column.is_lower_better else max)(some, key=lambda row: row[column.key])


def _best_words(rows: Rows, axes: Sequence[str], columns: Sequence[Column]) -> str:
    """Say in a sentence how many settings there are, and the best by the first metric and by the finest F1."""
    words = [f"{len(rows)} settings"]
    for column in columns:
        if column.key in (MAIN[0].key, "reconstruction/f1_5cm_percent"):
            best = _best(rows, column)
            values = ", ".join(f"{key}={best[key]}" for key in axes)
            words.append(f"best {column.title}: {column.factor * best[column.key]:.{column.digits}f} with {values}")
    return "; ".join(words) + "."


def _settings(folder: Path, rows: Rows, axes: Sequence[str], columns: Sequence[Column]) -> Table:
    """Lay out the prior alone, then each setting; without ground truth its frames instead of errors."""
    raw = {column.key: rows[0].get(RAW_PRIOR + column.key) for column in columns}
    lines = [Line(["", "raw prior", *[""] * (len(axes) - 1)], raw, rivals=None)]
    pictures = thumbnails([picture_path(folder, {key: row[key] for key in axes}) for row in rows])
    for row, content in zip(rows, pictures, strict=True):
        labels = [picture(content, "the map from above"), *(str(row[key]) for key in axes)]
        lines.append(Line(labels if columns else [*labels, run_facts(row)], row))
    titles = ("", *axes, *([] if columns else ["what it came to"]))
    return metric_table(titles, columns, lines if known(columns, lines[:1]) else lines[1:])


def _as_run(block: Mapping[str, Any], row: Mapping[str, Any], axes: Sequence[str]) -> str:
    """Write the command that makes a run with a map and a page of its own from a setting."""
    words = [f"{key}={row[key] if row[key] == 'inf' else written(row[key])}" for key in axes]
    return shlex.join(["emgs", "run", *repeat(block["config"]).words, *words])
