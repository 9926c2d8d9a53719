"""A sweep as people see it: its table, a picture of every metric over two axes, and report.html with every map."""

import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from emgs_jax.config.overrides import written
from emgs_jax.report.colors import save_figure
from emgs_jax.report.columns import MAIN, Column, Line, in_unit, known, markdown, metric_table
from emgs_jax.report.evaluation_page import run_facts
from emgs_jax.report.html import MAX_LINES, Head, commit_words, page, picture, thumbnails, write_page
from emgs_jax.report.provenance import RAW_PRIOR
from emgs_jax.report.repeat import repeat
from emgs_jax.report.sweeps import picture_path

Rows = Sequence[Mapping[str, Any]]  # a flat row for each setting: its values, then its metrics


def table(rows: Rows, axes: Sequence[str], data: str) -> str:
    """Write the values and main metrics of every row in Markdown; the best of a column is bold."""
    lines = [Line([str(row[name]) for name in axes], row) for row in rows]
    return markdown(metric_table(axes, known(MAIN, rows), lines, [data]))


def draw(path: str | os.PathLike, rows: Rows, axes: Mapping[str, Sequence[Any]], title: str, data: str) -> str | None:
    """Draw the main metrics over the first two axes with several values, as means over all others, and write PNG.

    Brighter is better. Returns None, or why there is no picture.
    """
    columns = in_unit(known(MAIN, rows), [data])
    several = [(name, [str(value) for value in values]) for name, values in axes.items() if len(values) > 1]
    if not columns:
        return "there is no ground truth to compare with"
    if len(several) < 2:
        return "a picture takes two axes with several values"
    (down, downs), (across, acrosses), *others = several
    if others:
        title += f", means over {', '.join(name for name, _ in others)}"
    per_line = min(len(columns), 3)
    num_lines = -(-len(columns) // per_line)
    width, height = 1.6 + 0.75 * len(acrosses), 1.3 + 0.45 * len(downs)
    figure = Figure(figsize=(per_line * width, num_lines * height + 0.5), facecolor="white", layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(num_lines, per_line, squeeze=False).ravel()
    for panel in panels[len(columns) :]:
        panel.axis("off")
    for panel, column in zip(panels, columns, strict=False):
        cells: dict[tuple[str, str], list[float]] = {}
        for row in rows:
            if row.get(column.key) is not None:
                cells.setdefault((str(row[down]), str(row[across])), []).append(column.factor * row[column.key])
        values = np.array([[np.mean(cells.get((a, b), [np.nan])) for b in acrosses] for a in downs])
        image = panel.imshow(values, cmap="viridis_r" if column.is_lower_better else "viridis", aspect="auto")
        for (line, place), value in np.ndenumerate(values):
            if np.isfinite(value):
                is_bright = image.cmap(image.norm(value))[:3] @ np.array([0.299, 0.587, 0.114]) > 0.5
                look = {"ha": "center", "va": "center", "color": "black" if is_bright else "white", "fontsize": 8}
                panel.text(place, line, f"{value:.{column.digits}f}", **look)
        panel.set_title(column.title, fontsize=10)
        panel.set_xticks(range(len(acrosses)), acrosses, fontsize=8)
        panel.set_yticks(range(len(downs)), downs, fontsize=8)
        panel.set_xlabel(across, fontsize=8)
        panel.set_ylabel(down, fontsize=8)
    save_figure(path, figure)
    return None


def write_sweep_page(folder: Path, block: Mapping[str, Any], rows: Rows, axes: Sequence[str], command: str) -> Path:
    """Write report.html into the folder of a sweep.

    Args:
        folder: of the sweep, with heat_map.png and pictures where there are any.
        rows: at least one.
        command: that repeats the sweep; "" where nobody knows.
    """
    name, prior = str(block["data"]["name"]), str(block["prior"]["name"])
    columns = in_unit(known(MAIN, rows), [name])
    title, words = f"{name} {block['data']['sequence']}", _best_words(rows, axes, columns)
    about = f"Protocol {block['protocol']}; {commit_words(block.get('git'))}, on {block['device']['kind']}"
    names = f"{title}: sweep", f"Sweep: {title}", f"prior {prior}"
    head = Head(*names, "unknown", words, block["simulated"], [about], command, [(name, prior)])
    shown, best = rows[:MAX_LINES], _best(rows, columns[0]) if columns else rows[0]
    (heat_map,) = thumbnails([folder / "heat_map.png"], (1300,))
    raw = {column.key: rows[0].get(RAW_PRIOR + column.key) for column in columns}
    lines = [Line(["", "raw prior", *[""] * (len(axes) - 1)], raw, rivals=None)] if known(columns, [raw]) else []
    pictures = thumbnails([picture_path(folder, {key: row[key] for key in axes}) for row in shown])
    for row, content in zip(shown, pictures, strict=True):
        labels = [picture(content, "the map from above"), *(str(row[key]) for key in axes)]
        lines.append(Line(labels if columns else [*labels, run_facts(row)], row))
    titles = ("", *axes, *([] if columns else ["what it came to"]))
    # As a run of its own the best setting has a map and a page.
    changed = [f"{key}={best[key] if best[key] == 'inf' else written(best[key])}" for key in axes]
    values = {
        "heat_map": picture(heat_map, "metrics over two axes"),
        "settings": metric_table(titles, columns, lines, [name]),
        "more": f"sweep.csv has {len(rows) - len(shown)} more settings." if len(rows) > len(shown) else "",
        "command": shlex.join(["emgs", "run", *repeat(block["config"]).words, *changed]),
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
