"""Frames in time: their statuses, curves and loops as SVG, which every browser shows without a program."""

from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.geometry import Sim3
from emgs_jax.report.recorded_run import RecordedRun

STATUS_COLORS = {
    "tracked": "#2f9e6e",
    "degraded": "#e69f2e",
    "lost": "#d9413f",
    "initialization": "#4c7de0",
    "skipped": "#a3aab5",
}
OURS, ONLINE, RAW = "#e4572e", "#d9a514", "#6b78e5"  # as in the map
_HEIGHT = 100.0  # units of a row's picture


class Curve(NamedTuple):
    """A number of each frame (n,), nan where there is none; a line of some colour."""

    values: np.ndarray
    color: str
    name: str


class PlacedPaths(NamedTuple):
    """Paths in the frame of the map, (n, 4, 4), nan where unknown, and errors of positions (n,) in metres."""

    truth: np.ndarray
    raw: np.ndarray
    errors: dict[str, np.ndarray]


def placed_paths(run: RecordedRun, with_scale: bool) -> PlacedPaths:
    """The true path and the raw prior's where they fit our path best, and what is left of the difference.

    Each path is placed on the true one by itself, as for its error in metrics.json. Without truth the raw prior's path
    stays where it is.
    """
    known = run.has_truth
    if not known.any():
        return PlacedPaths(run.truth, run.raw, {})
    ours, _ = align_poses(run.poses[known], run.truth[known], with_scale)
    back = ours.inverse()
    errors = {"ours": _errors(run.poses, run.truth, ours)}
    truth = np.where(known[:, None, None], back.apply_to_poses(run.truth), np.nan)
    raw = run.raw
    for name, poses in (("online", run.online), ("raw", run.raw)):
        if poses is None:
            continue
        rows = known & np.isfinite(poses).all((1, 2))
        if rows.any():
            alignment, _ = align_poses(poses[rows], run.truth[rows], with_scale)
            errors[name] = _errors(poses, run.truth, alignment)
            raw = back.apply_to_poses(alignment.apply_to_poses(poses)) if name == "raw" else raw
    return PlacedPaths(truth, raw, errors)


def strip(run: RecordedRun, errors: dict[str, np.ndarray]) -> str:
    """Rows of label, picture and range; one column a frame."""
    rows = [_row("frames", _statuses(run), _ends(run), 20)]
    column = {
        name: _numbers(run, name) for name in ("inliers", "residual", "scale", "new", "seconds", "compile_seconds")
    }
    column["residual"][column["inliers"] == 0] = np.nan  # of nothing
    if errors:
        look = {"raw": (RAW, "raw prior"), "online": (ONLINE, "as placed"), "ours": (OURS, "ours")}
        curves = [Curve(100 * errors[key], *look[key]) for key in look if key in errors]
        rows.append(_curves("error of the position", "cm", curves, 64, from_zero=True))
    for title, unit, values in (
        ("inliers", "points", column["inliers"]),
        ("residual", "% of the depth", 100 * column["residual"]),
        ("scale of the prediction", "", column["scale"]),
        ("new Gaussians", "", column["new"]),
        ("mapping", "s", column["seconds"] - column["compile_seconds"]),
    ):
        if np.isfinite(values).any():
            is_scale = title.startswith("scale")
            rows.append(_curves(title, unit, [Curve(values, "#3d4b63", "")], 34, from_zero=not is_scale))
    if run.loops:
        rows.append(_row("loops", _arcs(run), "", 60))
    return "".join(rows) + '<div id="track"><div id="cursor"></div></div>'


def key_of(run: RecordedRun, errors: dict[str, np.ndarray]) -> str:
    """Return the legend of the colours, in HTML."""
    found = {line["status"] for line in run.frames}
    parts = [(STATUS_COLORS[name], name) for name in STATUS_COLORS if name in found]
    if errors:
        parts += [(OURS, "ours"), (RAW, "raw prior")] + [(ONLINE, "as placed")] * ("online" in errors)
    return "".join(f'<i style="background:{color}"></i>{name}' for color, name in parts)


def _errors(poses: np.ndarray, truth: np.ndarray, alignment: Sim3) -> np.ndarray:
    return np.linalg.norm(alignment.apply(poses[:, :3, 3]) - truth[:, :3, 3], axis=1)


def _numbers(run: RecordedRun, name: str) -> np.ndarray:
    values = [line.get(name) for line in run.frames]
    return np.array([value if isinstance(value, int | float) else np.nan for value in values], np.float64)


def _row(label: str, picture: str, ends: str, height: int, unit: str = "") -> str:
    unit = f" <small>{escape(unit)}</small>" if unit else ""
    return f"<b>{escape(label)}{unit}</b>{_svg(picture, height)}<span>{ends}</span>"


def _svg(picture: str, height: int) -> str:
    count, _, content = picture.partition("|")
    box = f'viewBox="0 0 {count} {_HEIGHT:g}" preserveAspectRatio="none"'
    return f'<svg {box} height="{height}" role="img">{content}</svg>'


def _statuses(run: RecordedRun) -> str:
    """Runs of one status as one rectangle."""
    words = [line["status"] for line in run.frames]
    starts = [0, *(row for row in range(1, len(words)) if words[row] != words[row - 1])]
    parts = []
    for start, end in zip(starts, [*starts[1:], len(words)], strict=True):
        color = STATUS_COLORS.get(words[start], STATUS_COLORS["skipped"])
        box = f'x="{start}" width="{end - start}" y="0" height="{_HEIGHT:g}"'
        reasons = sorted({str(line.get("reason") or "") for line in run.frames[start:end]} - {""})
        title = escape(f"{words[start]}{': ' if reasons else ''}{'; '.join(reasons)}")
        parts.append(f'<rect {box} fill="{color}"><title>{title}</title></rect>')
    return f"{len(words)}|" + "".join(parts)


def _ends(run: RecordedRun) -> str:
    return f"{run.frames[0]['index']} – {run.frames[-1]['index']}" if run.frames else ""


def _curves(title: str, unit: str, curves: Sequence[Curve], height: int, from_zero: bool) -> str:
    finite = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in curves])
    low, high = 0.0 if from_zero else float(finite.min()), float(finite.max())
    span = high - low if high > low else 1.0
    lines = "".join(_line(curve, low, span) for curve in curves)
    return _row(title, f"{len(curves[0].values)}|{lines}", f"{_short(high)}<br>{_short(low)}", height, unit)


def _line(curve: Curve, low: float, span: float) -> str:
    """A curve, broken where there is no value; a value between two gaps is a dash of one column."""
    y = _HEIGHT * (0.96 - 0.92 * (curve.values - low) / span)
    rows = np.flatnonzero(np.isfinite(y))
    pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
    path = "".join(
        "M" + "L".join(f"{row + at:g} {y[row]:.2f}" for row in piece for at in ((0.5,) if len(piece) > 1 else (0, 1)))
        for piece in pieces
    )
    style = f'fill="none" stroke="{curve.color}" stroke-width="1.5" vector-effect="non-scaling-stroke"'
    return f'<path d="{path}" {style}><title>{escape(curve.name)}</title></path>'


def _arcs(run: RecordedRun) -> str:
    """A loop is an arc between its frames; only accepted ones are green."""
    parts = []
    for loop in sorted(run.loops, key=lambda item: item["outcome"] == "accepted"):
        a, b = loop["other"] + 0.5, loop["frame"] + 0.5
        is_accepted = loop["outcome"] == "accepted"
        color, opacity = (
            ("#1e9e50", 0.8) if is_accepted else ("#b3261e" if loop["outcome"] == "refused" else "#98a2b3", 0.45)
        )
        path = f"M{a:g} 100Q{(a + b) / 2:g} {-80 if is_accepted else -20:g} {b:g} 100"
        style = f'fill="none" stroke="{color}" opacity="{opacity}" vector-effect="non-scaling-stroke"'
        parts.append(f'<path d="{path}" {style}><title>{escape(loop_words(run, loop))}</title></path>')
    return f"{len(run.frames)}|" + "".join(parts)


GATES = {
    "matches": "too few matches fit one motion of the camera",
    "match_share": "too many matches do not fit one motion of the camera",
    "pose": "too few points of the one fit the image of the other",
    "poses_disagree": "the pose from the points of the one is not that from those of the other",
    "hull": "what both show is in a small part of an image",
    "collinear": "what both show lies on a line",
    "small": "what both show is one small object",
    "depths": "the ratios of the depths scatter",
    "scale": "the scale is not that of a metric prior",
    "neighbours": "too few of the neighbouring frames are verified as well",
    "neighbours_disagree": "the neighbouring frames say otherwise",
    "contradicted": "the one looks through what the other sees",
    "revisit": "the prior, asked for both together, says otherwise",
}
OUTCOMES = {
    "accepted": "accepted",
    "known": "verified; the poses said so already",
    "unconfirmed": "verified, but others do not agree",
    "unsolved": "verified, but no better poses were found with it",
}


def loop_why(loop: dict[str, Any]) -> str:
    """Outcome and reason."""
    gate = str(loop.get("gate", ""))
    why = f"refused: {GATES.get(gate, gate)}" if loop["outcome"] == "refused" else OUTCOMES[loop["outcome"]]
    return f"{why}: {loop['reason']}" if loop.get("reason") else why


def loop_words(run: RecordedRun, loop: dict[str, Any]) -> str:
    """Frames, by their index in the data set as everywhere on the page, outcome and reason."""
    frame, other = (run.frames[loop[name]]["index"] for name in ("frame", "other"))
    return f"frames {frame} and {other}: {loop_why(loop)}"


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
