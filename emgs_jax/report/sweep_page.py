"""report.html of a sweep: every setting with its metrics and a small picture of its map, beside the prior alone."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emgs_jax.report.columns import MAIN, Column
from emgs_jax.report.page_words import command_line, first_words, quiet, section
from emgs_jax.report.provenance import RAW_PRIOR
from emgs_jax.report.repeat import repeat, written
from emgs_jax.report.sweeps import picture_path
from emgs_jax.report.table_page import (
    MAX_LINES,
    best_of,
    number,
    picture,
    rows_of,
    run_facts,
    texts,
    thumbnails,
    write_page,
)

Rows = Sequence[Mapping[str, Any]]


def write_sweep_page(folder: Path, block: Mapping[str, Any], rows: Rows, axes: Sequence[str], command: str) -> Path:
    """Write report.html into the folder of a sweep.

    Args:
        folder: of the sweep, with heat_map.png and pictures where there are any.
        block: the provenance that all settings share.
        rows: a flat row for each setting, at least one.
        axes: their keys.
        command: that repeats the sweep; "" where nobody knows.
    """
    columns = [column for column in MAIN if any(row.get(column.key) is not None for row in rows)]
    name, prior, git = str(block["data"]["name"]), str(block["prior"]["name"]), block.get("git") or {}
    title = f"{name} {block['data']['sequence']}"
    head = first_words(
        f"Sweep: {title}", f"prior {prior}", "unknown", _best_words(rows, axes, columns), block["simulated"]
    )
    commit = f"commit {git['revision'][:12]}{' with changes' if git.get('dirty') else ''}" if git else "no checkout"
    head += quiet(f"Protocol {block['protocol']}; {commit}, on {block['device']['kind']}")
    head += command_line(command) if command else ""
    parts = [section("Settings", _settings(folder, rows, axes, columns)), _as_run(block, rows, axes, columns)]
    if (folder / "heat_map.png").is_file():
        (content,) = thumbnails([folder / "heat_map.png"], (1300,))
        parts.insert(0, section("Metrics over two axes", picture(content, "metrics over two axes")))
    return write_page(folder, f"{title}: sweep", head, parts, [(name, prior)])


def _best(rows: Rows, column: Column) -> Mapping[str, Any]:
    known = [row for row in rows if row.get(column.key) is not None]
    return (min if column.is_lower_better else max)(known, key=lambda row: row[column.key])


def _best_words(rows: Rows, axes: Sequence[str], columns: Sequence[Column]) -> str:
    """Describe in a sentence how many settings there are, and the best by the first metric and by the finest F1."""
    words = [f"{len(rows)} settings"]
    for column in columns:
        if column.key in (MAIN[0].key, "reconstruction/f1_5cm_percent"):
            best = _best(rows, column)
            values = ", ".join(f"{key}={best[key]}" for key in axes)
            words.append(f"best {column.title}: {column.factor * best[column.key]:.{column.digits}f} with {values}")
    return "; ".join(words) + "."


def _settings(folder: Path, rows: Rows, axes: Sequence[str], columns: Sequence[Column]) -> str:
    """The prior alone, then a line for each setting; without ground truth its frames instead of errors."""
    shown = rows[:MAX_LINES]
    best = [best_of((row.get(column.key) for row in rows), column) for column in columns]
    lines = []
    if any(RAW_PRIOR + column.key in rows[0] for column in columns):
        cells = "".join(number(rows[0].get(RAW_PRIOR + column.key), column) for column in columns)
        lines.append("<td></td>" + texts(["raw prior", *[""] * (len(axes) - 1)]) + cells)
    pictures = thumbnails([picture_path(folder, {key: row[key] for key in axes}) for row in shown])
    for row, content in zip(shown, pictures, strict=True):
        metrics = "".join(number(row.get(column.key), column, top) for column, top in zip(columns, best, strict=True))
        metrics = metrics if columns else texts([run_facts(row)])
        values = texts(str(row[key]) for key in axes)
        lines.append(f"<td>{picture(content, 'the map from above')}</td>{values}{metrics}")
    more = f"sweep.csv has {len(rows) - len(shown)} more settings." if len(rows) > len(shown) else ""
    titles = ("", *axes, *([] if columns else ["what it came to"]))
    return rows_of(titles, [column.title for column in columns], lines) + quiet(more)


def _as_run(block: Mapping[str, Any], rows: Rows, axes: Sequence[str], columns: Sequence[Column]) -> str:
    """The command that makes a run with a map and a page of its own from the best setting."""
    best = _best(rows, columns[0]) if columns else rows[0]
    words = [f"{key}={best[key] if best[key] == 'inf' else written(best[key])}" for key in axes]
    command = shlex.join(["emgs", "run", *repeat(block["config"]).words, *words])
    note = "Settings of a sweep are mapped and scored only; as a run of its own one has a map and a page:"
    return section("The best setting as a run", quiet(note) + command_line(command))
