"""Words and tables of the page: verdict, errors, loops, settings, files, licences. All of it escaped."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from emgs_jax.report import provenance
from emgs_jax.report.columns import BY_PATH, MAIN, PLACED, RENDERED, Column, cell
from emgs_jax.report.page_strip import loop_why, loop_words
from emgs_jax.report.provenance import RAW_PRIOR, ROWS
from emgs_jax.report.recorded_run import POLISH, RecordedRun
from emgs_jax.report.repeat import Repeated

MANY_LOST = 0.1  # share of the frames
_SE3 = Column("trajectory/ate_se3_m", "ATE SE(3) [cm]", 100.0, 2, True)
_COLUMNS = (MAIN[0]._replace(title="ATE Sim(3) [cm]"), _SE3, *PLACED[:1], *PLACED[3:4], *BY_PATH, *RENDERED)
FILES = {
    "report.html": "this page; any browser of 2023 or later",
    "overview.png": "the map from above with both paths, some frames; any viewer of images",
    "metrics.json": "all errors, counts, times, and where the result comes from; any editor",
    "trajectory.txt": "the pose of every frame, TUM format; evo",
    "trajectory_online.txt": "the poses as they were when the frames were placed, TUM format; evo",
    "frames.jsonl": "a line per frame; any editor, pandas.read_json(…, lines=True)",
    "graph.g2o": "poses and measurements; what reads g2o files",
    "loops.json": "candidates of loops and what became of them; any editor",
    "map.npz": "the map itself: emgs_jax.load_map",
    "text.npz": "classes that the map's features are compared with; features.text=",
    "map.ply": "the Gaussians as 3D Gaussian splatting has them; splat-transform, rerun",
    "points.ply": "a dense cloud with normals, colours and labels; MeshLab, CloudCompare, Open3D",
    "mesh.ply": "a mesh from centres and normals; MeshLab, CloudCompare, Open3D",
    "splats.ply": "splats fitted to the images (emgs polish), standard 3DGS; SuperSplat, gsplat, nerfstudio",
    "polish.png": "frames that were held out: image, map, splats; any viewer of images",
    "polish.json": "PSNR, SSIM and depth errors of those before and after; any editor",
    "polish.txt": "poses as they moved with the splats (polish.poses=true), TUM format; evo",
    "cameras.ply": "every camera in the colour of its status, and the path, as a mesh; MeshLab, CloudCompare",
}
POLISHED = (  # key of polish.json, words, digits
    ("psnr_db", "PSNR, dB", 2),
    ("ssim", "SSIM", 3),
    ("depth_within_5_percent", "depth within 5 %, %", 1),
    ("depth_l1_m", "depth L1, m", 3),
    ("ate_m", "ATE of all frames, m", 4),
)
_OWN = "made by this program, Apache-2.0"
DATA_LICENCES = {
    "synthetic": _OWN,
    "apartment": _OWN,
    "tum": "TUM RGB-D: CC BY 4.0; another folder of this layout: see its publisher",
    "seven_scenes": "7-Scenes: see the data set's page at Microsoft Research",
    "bonn": "Bonn RGB-D Dynamic: see the data set's page at the University of Bonn",
    "euroc": "EuRoC MAV: see the data set's page at ETH Zurich; another folder of this layout: see its publisher",
    "kitti": "KITTI: CC BY-NC-SA 3.0",
    "replica": "Replica: Replica Dataset Research Terms, for research and education that is not commercial",
    **dict.fromkeys(("images", "colmap", "nerfstudio", "rosbag"), "your own images, your own licence"),
}


def verdict(run: RecordedRun) -> tuple[str, str]:
    """`good`, `mixed`, `bad` or `unknown`, and one sentence. Without ground truth only the tracking is judged.

    Bad: more than a tenth of the frames is lost, or the path is worse than the raw prior's. Mixed: of the true depth
    fewer pixels are met than by the raw prior, or a tenth of the frames is degraded.
    """
    metrics, statuses = run.metrics, Counter(line["status"] for line in run.frames)
    total = max(len(run.frames), 1)
    tracked = f"{statuses['tracked'] + statuses['initialization']} of {len(run.frames)} frames are in the map"
    if statuses["lost"] or statuses["degraded"]:
        tracked += f" ({statuses['degraded']} degraded, {statuses['lost']} lost)"
    tracked += f", {len(run.skipped)} skipped" if run.skipped else ""
    is_lost, is_degraded = (statuses[word] > MANY_LOST * total for word in ("lost", "degraded"))
    ours, raw = (metrics.get(prefix + MAIN[0].key) for prefix in ("", RAW_PRIOR))
    if ours is None:
        level = "bad" if is_lost else "mixed" if is_degraded else "unknown"
        return level, f"{tracked}. There is no ground truth that errors could be told from."
    has_metres = provenance.has_metric_truth(run.provenance)

    def length(value: float) -> str:
        return f"{100 * value:.1f} cm" if has_metres else f"{value:.3g} units of the reference"

    words = f"The path is off by {length(ours)} (RMS, placed with its scale)"
    is_worse = raw is not None and ours > raw
    if raw:
        change = f"{100 * abs(1 - ours / raw):.0f} % {'more' if is_worse else 'less'}"
        words += f", {change} than the prior alone ({length(raw)})"
    key = "rendering/depth_within_5_percent"
    met, met_raw = metrics.get(key), metrics.get(RAW_PRIOR + key)
    if met is not None and met_raw is not None:
        words += f"; {met:.0f} % of the true depths are rendered within 5 % (prior alone: {met_raw:.0f} %)"
    is_mixed = is_degraded or (met is not None and met_raw is not None and met < met_raw)
    level = "bad" if is_lost or is_worse else "mixed" if is_mixed else "good"
    return level, f"{words}; {tracked}."


def is_metric(run: RecordedRun) -> bool:
    """Test whether lengths of the map are meant to be metres."""
    return provenance.is_metric(run.provenance["prior"].get("settings", {}))


def head(run: RecordedRun, again: Repeated) -> str:
    """Return the head of the page: data and prior, verdict, versions, and the command that repeats the run."""
    block, (level, words) = run.provenance, verdict(run)
    data, prior = block["data"], block["prior"]
    title = f"{data['name']} {data['sequence']}"
    parts = [first_words(title, f"prior {prior['name']}", level, words, block["simulated"])]
    if not is_metric(run):
        parts.append(quiet("Images alone do not tell the scale: lengths follow from a median depth that was assumed."))
    git = block.get("git") or {}
    commit = f"commit {git['revision'][:12]}{' with changes' if git.get('dirty') else ''}" if git else "no checkout"
    device = block.get("device", {}).get("kind", "")
    size = f"{run.camera.width} × {run.camera.height} pixels"
    where = f"emgs_jax {block['versions']['emgs_jax']}, {commit}, on {device}; images of {size}"
    return "".join([*parts, quiet(where), command_line(again.command)])


def first_words(title: str, more: str, level: str, words: str, is_simulated: bool) -> str:
    """Title with the simulated label, verdict, and what the label means."""
    badge = ' <span class="badge">SIMULATED</span>' if is_simulated else ""
    heading = f"<h1>{escape(title)} <small>{escape(more)}</small>{badge}</h1>"
    note = "Simulated: the prior is the disturbed ground truth. Numbers must not be set beside published ones."
    return f'{heading}<p class="verdict {level}">{escape(words)}</p>{quiet(note if is_simulated else "")}'


def command_line(command: str) -> str:
    """Return the command that repeats the run, in HTML."""
    return f"<p><code>{escape(command)}</code></p>"


def errors(run: RecordedRun) -> str:
    """The table of errors: ours, as placed, the raw prior and baselines."""
    metrics, config = run.metrics, run.provenance["config"].get("evaluation", {})
    if not any(MAIN[0].key in key for key in metrics):
        return section("Errors", "<p>None: the data set has no ground truth.</p>")
    names = {prefix: name for prefix, name in ROWS.items() if any(prefix + c.key in metrics for c in _COLUMNS)}
    rows = [(name, [metrics.get(prefix + column.key) for column in _COLUMNS]) for prefix, name in names.items()]
    online = {
        column.key: metrics.get(column.key.replace("trajectory/", "trajectory_online/")) for column in _COLUMNS[:2]
    }
    if any(value is not None for value in online.values()):
        rows.insert(1, ("ours, as placed", [online.get(column.key) for column in _COLUMNS]))
    lines = []
    for k, column in enumerate(_COLUMNS):
        known = [values[k] for _, values in rows if values[k] is not None]
        if not known:
            continue
        best, cells = (min if column.is_lower_better else max)(known), []
        for _, values in rows:
            mark = ' class="best"' if values[k] == best and len(known) > 1 else ""
            cells.append(f"<td{mark}>{cell(values[k], None, column.factor, column.digits)}</td>")
        lines.append(f"<tr><td>{escape(column.title)}</td>{''.join(cells)}</tr>")
    titles = "".join(f"<th>{escape(name)}</th>" for name, _ in rows)
    how = (
        f"Protocol {run.provenance['protocol']}: {config.get('statistic', 'mean')} distances, clouds placed by their "
        f"points (ICP) or by the path ({config.get('alignment')}); rendered at each one's own poses. "
        f"{metrics.get('trajectory/num_frames')} frames with truth. Raw prior: the same predictions without mapping."
    )
    return section("Errors", f"<table><tr><th></th>{titles}</tr>{''.join(lines)}</table>{quiet(how)}")


def loops(run: RecordedRun) -> str:
    """Counts of outcomes with their reasons, and every candidate; nothing without a back end."""
    if not run.loops:
        return ""
    counts = Counter(map(loop_why, run.loops)).most_common()
    rows = [(f"{count}", words) for words, count in counts]
    each = "".join(f"<li>{escape(loop_words(run, loop))}</li>" for loop in run.loops[:500])
    more = f"<li>and {len(run.loops) - 500} more in loops.json</li>" if len(run.loops) > 500 else ""
    closures = f"{run.metrics.get('loops/closures', 0)} closures moved poses and map."
    outcomes = table(("candidates", "outcome"), rows)
    return section(
        "Loops", f"{outcomes}{quiet(closures)}<details><summary>each of them</summary><ul>{each}{more}</ul></details>"
    )


def settings(again: Repeated) -> str:
    """Return the section of the settings that differ from the defaults."""
    rows = [(key, _plain(value), _plain(default)) for key, value, default in again.differences]
    body = table(("setting", "here", "default"), rows) if rows else "<p>None: all settings are the defaults.</p>"
    return section("Settings that differ from the defaults", body)


def polished(run: RecordedRun) -> str:
    """What `emgs polish` has changed on the frames that it held out; nothing where it was not run."""
    path = run.folder / POLISH[1]
    if not path.is_file():
        return ""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        count, held = (int(found[f"polish/{name}"]) for name in ("num_splats", "num_held_out"))
        rows = [
            (words, *(f"{float(found[f'polish/{when}_{name}']):.{digits}f}" for when in ("before", "after")))
            for name, words, digits in POLISHED
            if found.get(f"polish/before_{name}") is not None
        ]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not what emgs polish writes ({error!r}): polish again") from error
    words = f"{count:,} splats; the {held} frames that are compared were not fitted."
    return section("Polished", table(("held-out frames", "map", "splats"), rows) + quiet(words))


def files(run: RecordedRun, note: str) -> str:
    """Return the section of the files beside the page, with the programs that open them."""
    there = [(name, words) for name, words in FILES.items() if name == "report.html" or (run.folder / name).is_file()]
    return section("Files of the run", table(("file", "what it is; what opens it"), there) + quiet(note))


def licences(run: RecordedRun) -> str:
    """Of the program, the data and the prior of a run."""
    return licence_words(str(run.provenance["data"]["name"]), str(run.provenance["prior"]["name"]))


def licence_words(name: str, prior: str) -> str:
    """Of the program, a data set and a prior."""
    data = DATA_LICENCES.get(name, f"{name}: see its publisher")
    is_own = prior.startswith(("simulated", "multiview_stereo"))
    network = "" if is_own else "; its weights have a licence of their own: docs/priors.md"
    own = "Licences. Page and program: emgs_jax, Apache-2.0."
    return f"<p>{own} Data: {escape(data)}. Prior: {escape(prior)}{network}.</p>"


def section(title: str, body: str) -> str:
    """A part of the page; `body` is HTML."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts."""
    lines = ["".join(f'<td class="text">{escape(text)}</td>' for text in row) for row in rows]
    top = "".join(f'<th class="text">{escape(title)}</th>' for title in titles)
    return f"<table><tr>{top}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def quiet(text: str) -> str:
    """A side remark; nothing for an empty one."""
    return f'<p class="quiet">{escape(text)}</p>' if text else ""


def _plain(value: Any) -> str:
    if value is ...:
        return "not there"
    return ", ".join(map(str, value)) if isinstance(value, list) else "none" if value is None else str(value)


def frame_facts(line: Mapping[str, Any]) -> str:
    """Numbers of a frame in one line."""
    known = {
        "inliers": lambda v: f"{v:,} inliers",
        "residual": lambda v: f"residual {100 * v:.1f} % of the depth",
        "scale": lambda v: f"scale {v:.3f}",
        "new": lambda v: f"{v:,} new",
        "num_gaussians": lambda v: f"{v:,} Gaussians",
        "seconds": lambda v: f"{v:.2f} s",
    }
    found = [say(line[name]) for name, say in known.items() if isinstance(line.get(name), int | float)]
    return " · ".join(found)
