"""One picture of a sweep: every metric over two axes."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emgs_jax.report.colors import save_figure
from emgs_jax.report.columns import MAIN, Column, Line, known

Axis = tuple[str, list[str]]  # its name and its tick labels


def draw(
    path: str | os.PathLike, rows: Sequence[Mapping[str, Any]], axes: Mapping[str, Sequence[Any]], title: str
) -> str | None:
    """Draw the main metrics over the first two axes with several values, as means over all others, and write PNG.

    Returns:
        None, or why there is no picture.
    """
    shown = known(MAIN, [Line((), row) for row in rows])
    several = [(name, [str(value) for value in values]) for name, values in axes.items() if len(values) > 1]
    if len(several) < 2 or not shown:
        return "a picture takes two axes with several values" if shown else "there is no ground truth to compare with"
    if len(several) > 2:
        title += f", means over {', '.join(name for name, _ in several[2:])}"
    maps = [(column, means(rows, column, *several[:2])) for column in shown]
    draw_heat_maps(path, maps, *several[:2], title)
    return None


def means(rows: Sequence[Mapping[str, Any]], column: Column, down: Axis, across: Axis) -> np.ndarray:
    """Average a metric in its column's unit, (values down, values across); nan where there is none."""
    cells: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row.get(column.key) is not None:
            cells.setdefault((str(row[down[0]]), str(row[across[0]])), []).append(column.factor * row[column.key])
    return np.array([[np.mean(cells.get((a, b), [np.nan])) for b in across[1]] for a in down[1]])


def draw_heat_maps(
    path: str | os.PathLike, maps: Sequence[tuple[Column, np.ndarray]], down: Axis, across: Axis, title: str
) -> None:
    """Draw metrics side by side, brighter is better, and write them as PNG."""
    per_line = min(len(maps), 3)
    lines = -(-len(maps) // per_line)
    width, height = 1.6 + 0.75 * len(across[1]), 1.3 + 0.45 * len(down[1])
    figure = Figure(figsize=(per_line * width, lines * height + 0.5), facecolor="white", layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(lines, per_line, squeeze=False).ravel()
    for panel in panels[len(maps) :]:
        panel.axis("off")
    for panel, (column, values) in zip(panels, maps, strict=False):
        _draw(panel, column, values)
        panel.set_xticks(range(len(across[1])), across[1], fontsize=8)
        panel.set_yticks(range(len(down[1])), down[1], fontsize=8)
        panel.set_xlabel(across[0], fontsize=8)
        panel.set_ylabel(down[0], fontsize=8)
    save_figure(path, figure)


def _draw(axes: Axes, column: Column, values: np.ndarray) -> None:
    image = axes.imshow(values, cmap="viridis_r" if column.is_lower_better else "viridis", aspect="auto")
    for (row, place), value in np.ndenumerate(values):
        if np.isfinite(value):
            is_bright = image.cmap(image.norm(value))[:3] @ np.array([0.299, 0.587, 0.114]) > 0.5
            look = {"ha": "center", "va": "center", "color": "black" if is_bright else "white", "fontsize": 8}
            axes.text(place, row, f"{value:.{column.digits}f}", **look)
    axes.set_title(column.title, fontsize=10)
