"""One picture of a sweep: every metric over two axes."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emgs_jax.io.files import atomic_write


@dataclass(frozen=True)
class HeatMap:
    """A metric over two axes.

    Args:
        title: of the metric, with its unit.
        values: (rows, columns); NaN where there is none.
        digits: after the decimal point.
        is_lower_better: which end is drawn bright.
    """

    title: str
    values: np.ndarray
    digits: int
    is_lower_better: bool


def draw_heat_maps(
    path: str | os.PathLike,
    maps: Sequence[HeatMap],
    rows: tuple[str, Sequence[str]],
    columns: tuple[str, Sequence[str]],
    title: str,
) -> None:
    """Draw the maps side by side, brighter is better, and write them as PNG.

    Args:
        maps: of one shape.
        rows: name and tick labels of the vertical axis.
        columns: likewise of the horizontal one.
        title: of the whole picture.
    """
    per_line = min(len(maps), 3)
    lines = -(-len(maps) // per_line)
    width, height = 1.6 + 0.75 * len(columns[1]), 1.3 + 0.45 * len(rows[1])
    figure = Figure(figsize=(per_line * width, lines * height + 0.5), facecolor="white", layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(lines, per_line, squeeze=False).ravel()
    for panel, heat_map in zip(panels, maps, strict=False):
        _draw(panel, heat_map, rows, columns)
    for panel in panels[len(maps) :]:
        panel.axis("off")
    with atomic_write(path) as handle:
        figure.savefig(handle, format="png", dpi=110)


def _draw(axes: Axes, heat_map: HeatMap, rows: tuple[str, Sequence[str]], columns: tuple[str, Sequence[str]]) -> None:
    image = axes.imshow(heat_map.values, cmap="viridis_r" if heat_map.is_lower_better else "viridis", aspect="auto")
    for (row, column), value in np.ndenumerate(heat_map.values):
        if np.isfinite(value):
            red, green, blue, _ = image.cmap(image.norm(value))
            is_bright = 0.299 * red + 0.587 * green + 0.114 * blue > 0.5
            text = f"{value:.{heat_map.digits}f}"
            axes.text(column, row, text, ha="center", va="center", color="black" if is_bright else "white", fontsize=8)
    axes.set_title(heat_map.title, fontsize=10)
    axes.set_xticks(range(len(columns[1])), columns[1], fontsize=8)
    axes.set_yticks(range(len(rows[1])), rows[1], fontsize=8)
    axes.set_xlabel(columns[0], fontsize=8)
    axes.set_ylabel(rows[0], fontsize=8)
