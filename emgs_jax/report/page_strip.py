"""Frames over time: statuses, curves and loops as shapes, which web/run.html draws as SVG without a program."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emgs_jax.drawing.colors import PATHS, STATUS_COLORS
from emgs_jax.report.page_words import loop_words
from emgs_jax.runs.finished_run import FinishedRun
from emgs_jax.runs.provenance import has_metric_truth

HEIGHT = 100.0  # units of a row's picture; horizontally one unit is one frame
ERRORS = {"raw": "raw prior", "online": "as placed", "ours": "ours"}
_COLORS = {name: PATHS["poses" if name == "ours" else name].paper for name in ERRORS}


class Shape(NamedTuple):
    """A path of SVG with a title."""

    path: str
    title: str
    fill: str = "none"
    stroke: str = "none"
    opacity: float = 1.0


class Row(NamedTuple):
    """A line of the strip: its label with a unit, height in pixels, range from the top, and picture."""

    label: str
    unit: str
    height: int
    ends: Sequence[str]
    shapes: Sequence[Shape]


def strip(run: FinishedRun, errors: dict[str, np.ndarray]) -> list[Row]:
    """Draw statuses, errors of positions [m] by name, the frames' numbers, and loops."""
    ends = [f"{run.frames[0]['index']} – {run.frames[-1]['index']}"] if run.frames else []
    rows = [Row("frames", "", 20, ends, _statuses(run))]
    if errors:
        factor, unit = (100, "cm") if has_metric_truth(run.provenance) else (1, "units")
        curves = {name: factor * errors[name] for name in ERRORS if name in errors}
        rows.append(_curves("error of the position", unit, curves, 64))
    names = "inliers", "residual", "scale", "moving", "new", "seconds", "compile_seconds"
    inliers, residual, scale, moving, new, seconds, compiling = (_numbers(run, name) for name in names)
    residual[inliers == 0] = np.nan  # undefined without inliers
    moving = np.where((moving > 0).any(), moving, np.nan)
    for label, unit, values in (
        ("inliers", "points", inliers),
        ("residual", "% of the depth", 100 * residual),
        ("scale of the prediction", "", scale),
        ("what moves", "% of the pixels", 100 * moving),
        ("new Gaussians", "", new),
        ("mapping", "s", seconds - compiling),
    ):
        if np.isfinite(values).any():
            rows.append(_curves(label, unit, {"": values}, 34, from_zero=values is not scale))
    return [*rows, Row("loops", "", 60, [], _arcs(run))] if run.loops else rows


def key_of(run: FinishedRun, errors: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Pair colours with their meanings."""
    found = {line["status"] for line in run.frames}
    statuses = [(color, name) for name, color in STATUS_COLORS.items() if name in found]
    return statuses + [(_COLORS[name], ERRORS[name]) for name in ("ours", "raw", "online") if name in errors]


def _numbers(run: FinishedRun, name: str) -> np.ndarray:
    values = [line.get(name) for line in run.frames]
    return np.array([value if isinstance(value, int | float) else np.nan for value in values], np.float64)


def _statuses(run: FinishedRun) -> list[Shape]:
    """Draw consecutive frames of one status as one rectangle."""
    words = [line["status"] for line in run.frames]
    starts = [0, *(row for row in range(1, len(words)) if words[row] != words[row - 1])]
    shapes = []
    for start, end in zip(starts, [*starts[1:], len(words)], strict=True):
        reasons = sorted({str(line.get("reason") or "") for line in run.frames[start:end]} - {""})
        title = f"{words[start]}{': ' if reasons else ''}{'; '.join(reasons)}"
        color = STATUS_COLORS.get(words[start], STATUS_COLORS["skipped"])
        shapes.append(Shape(f"M{start} 0H{end}V{HEIGHT:g}H{start}Z", title, fill=color))
    return shapes


def _curves(label: str, unit: str, curves: dict[str, np.ndarray], height: int, from_zero: bool = True) -> Row:
    """Draw numbers of each frame (n,), nan for none, over one range."""
    finite = np.concatenate([values[np.isfinite(values)] for values in curves.values()])
    low, high = 0.0 if from_zero else float(finite.min()), float(finite.max())
    span = high - low if high > low else 1.0
    shapes = [
        Shape(_line((values - low) / span), ERRORS.get(name, ""), stroke=_COLORS.get(name, "#3d4b63"))
        for name, values in curves.items()
    ]
    return Row(label, unit, height, [_short(high), _short(low)], shapes)


def _line(shares: np.ndarray) -> str:
    """Draw a curve of values in [0, 1], broken at gaps; a value between two gaps is a dash of one column."""
    y = HEIGHT * (0.96 - 0.92 * shares)
    rows = np.flatnonzero(np.isfinite(y))
    pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
    return "".join(
        "M" + "L".join(f"{row + at:g} {y[row]:.2f}" for row in piece for at in ((0.5,) if len(piece) > 1 else (0, 1)))
        for piece in pieces
    )


def _arcs(run: FinishedRun) -> list[Shape]:
    """Draw a loop as an arc between its frames; only accepted ones are green."""
    shapes = []
    for loop in sorted(run.loops, key=lambda item: item["outcome"] == "accepted"):
        a, b = loop["other"] + 0.5, loop["frame"] + 0.5
        is_accepted = loop["outcome"] == "accepted"
        color = {"accepted": "#1e9e50", "refused": "#b3261e"}.get(loop["outcome"], "#98a2b3")
        path = f"M{a:g} {HEIGHT:g}Q{(a + b) / 2:g} {-80 if is_accepted else -20:g} {b:g} {HEIGHT:g}"
        shapes.append(Shape(path, loop_words(run, loop), stroke=color, opacity=0.8 if is_accepted else 0.45))
    return shapes


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
