"""Words and tables of a run's page: verdict, errors, loops, settings, files."""

import json
from collections import Counter
from typing import Any

from emgs_jax.loop_closure.two_view_alignment import Gate
from emgs_jax.mapping.records import APART
from emgs_jax.report.columns import (
    BY_PATH,
    MAIN,
    PLACED,
    RENDERED,
    SHARE,
    Column,
    Line,
    Table,
    known,
    lines_of,
    metric_table,
    transposed,
)
from emgs_jax.report.html import Head, commit_words
from emgs_jax.report.printout import polish_table
from emgs_jax.runs.finished_run import POLISH, FinishedRun
from emgs_jax.runs.provenance import RAW_PRIOR, length_words
from emgs_jax.runs.repeat import Repeated
from emgs_jax.runs.results import sound

MANY_LOST = 0.1  # share of the frames
MAX_LOOPS = 500  # largest number listed
_SE3 = Column("trajectory/ate_se3_m", "ATE SE(3) [cm]", 100.0, 2, True)
_COLUMNS = (MAIN[0]._replace(title="ATE Sim(3) [cm]"), _SE3, SHARE, *PLACED[:1], *PLACED[3:4], *BY_PATH, *RENDERED)
FILES = {
    "report.html": "this page; any browser of 2023 or later",
    "overview.png": "the map from above with both paths, some frames; any viewer of images",
    "metrics.json": "all errors, counts, times, and where the result comes from; any editor",
    "trajectory.txt": "the pose of every frame that is placed, TUM format; evo",
    "trajectory_online.txt": "the poses as they were when the frames were placed, TUM format; evo",
    "frames.jsonl": "a line per frame; any editor, pandas.read_json(…, lines=True)",
    "graph.g2o": "poses and measurements; what reads g2o files",
    "loops.json": "candidates of loops and what became of them; any editor",
    "map.npz": "the map itself: emgs_jax.load_map",
    "structure": "poses, points and lens of the images; COLMAP",
    "submaps": "map and path of each part that was never joined with the map; emgs_jax.load_map",
    "text.npz": "classes that the map's features are compared with; features.text=",
    "map.ply": "the Gaussians as 3D Gaussian splatting has them; splat-transform, rerun",
    "points.ply": "a dense cloud with normals, colours and labels; MeshLab, CloudCompare, Open3D",
    "mesh.ply": "a mesh from centres and normals; MeshLab, CloudCompare, Open3D",
    "splats.ply": "splats fitted to the images (emgs polish), standard 3DGS; SuperSplat, gsplat, nerfstudio",
    "polish.png": "frames that were held out: image, map, splats; any viewer of images",
    "polish.json": "PSNR, SSIM and depth errors of those before and after; any editor",
    "polish.txt": "poses as they moved with the splats, TUM format; evo",
    "cameras.ply": "every camera in the colour of its status, and the path, as a mesh; MeshLab, CloudCompare",
}
GATES = {gate.value: gate.words for gate in Gate}
OUTCOMES = {
    "accepted": "accepted",
    "known": "verified; the poses said so already",
    "unconfirmed": "verified, but others do not agree",
    "unsolved": "verified, but no better poses were found with it",
}


def loop_why(loop: dict[str, Any]) -> str:
    """Describe the outcome of a loop candidate, and its reason."""
    gate = str(loop.get("gate", ""))
    why = f"refused: {GATES.get(gate, gate)}" if loop["outcome"] == "refused" else OUTCOMES[loop["outcome"]]
    return f"{why}: {loop['reason']}" if loop.get("reason") else why


def loop_words(run: FinishedRun, loop: dict[str, Any]) -> str:
    """Describe a loop: frames by their index in the data set, as everywhere on the page, outcome and reason."""
    frame, other = (run.frames[loop[name]]["index"] for name in ("frame", "other"))
    return f"frames {frame} and {other}: {loop_why(loop)}"


def no_errors(run: FinishedRun) -> str:
    """Say why a run without errors has none."""
    return "no placed frame has a true pose" if run.has_truth.any() else "the data set has no ground truth"


def verdict(run: FinishedRun) -> tuple[str, str]:
    """Judge as `good`, `mixed`, `bad` or `unknown`, in one sentence; without ground truth by the tracking alone.

    Bad: more than a tenth of the frames is lost, or the path is worse than the raw prior's. Mixed: fewer pixels have
    the true depth than in the raw prior, or a tenth of the frames is degraded.
    """
    metrics, statuses = run.metrics, Counter(line["status"] for line in run.frames)
    total = max(len(run.frames), 1)
    tracked = f"{statuses['tracked'] + statuses['initialization']} of {len(run.frames)} frames are in the map"
    if statuses["lost"] or statuses["degraded"]:
        tracked += f" ({statuses['degraded']} degraded, {statuses['lost']} lost)"
    if statuses[APART]:
        tracked += f", {statuses[APART]} in submaps that were never joined with it"
    tracked += f", {len(run.skipped)} skipped" if run.skipped else ""
    statuses["lost"] += statuses[APART]
    is_lost, is_degraded = (statuses[word] > MANY_LOST * total for word in ("lost", "degraded"))
    ours, raw = (metrics.get(prefix + MAIN[0].key) for prefix in ("", RAW_PRIOR))
    if ours is None:
        level = "bad" if is_lost else "mixed" if is_degraded else "unknown"
        return level, f"{tracked}. There are no errors to tell: {no_errors(run)}."
    words = f"The path is off by {length_words(ours, run.provenance)} (RMS, placed with its scale)"
    is_worse = raw is not None and ours > raw
    if raw:
        change = f"{100 * abs(1 - ours / raw):.0f} % {'more' if is_worse else 'less'}"
        words += f", {change} than the prior alone ({length_words(raw, run.provenance)})"
    key = "rendering/depth_within_5_percent"
    met, met_raw = metrics.get(key), metrics.get(RAW_PRIOR + key)
    if met is not None and met_raw is not None:
        words += f"; {met:.0f} % of the true depths are rendered within 5 % (prior alone: {met_raw:.0f} %)"
    is_mixed = is_degraded or (met is not None and met_raw is not None and met < met_raw)
    level = "bad" if is_lost or is_worse else "mixed" if is_mixed else "good"
    return level, f"{words}; {tracked}."


def head(run: FinishedRun, again: Repeated) -> Head:
    """Write the head of the page: data and prior, verdict, versions, and the command that repeats the run."""
    block, (level, words) = run.provenance, verdict(run)
    data, prior = block["data"], block["prior"]
    title, size = f"{data['name']} {data['sequence']}", f"{run.camera.width} × {run.camera.height} pixels"
    version, device = block["versions"]["emgs_jax"], block["device"]["kind"]
    remarks = [f"emgs_jax {version}, {commit_words(block['git'])}, on {device}; images of {size}"]
    if not run.is_metric:
        remarks.insert(0, "Images alone do not tell the scale: lengths follow from a median depth that was assumed.")
    sources = [(str(data["name"]), str(prior["name"]))]
    window, beside = f"{title}: report of a run", f"prior {prior['name']}"
    return Head(window, title, beside, level, words, block["simulated"], remarks, again.command, sources)


def errors(run: FinishedRun) -> Table | None:
    """Lay out our errors, and those of online poses, raw prior and baselines, side by side; None without any."""
    metrics = run.metrics
    if not any(MAIN[0].key in key for key in metrics):
        return None
    lines = [line._replace(rivals=()) for line in lines_of(metrics, _COLUMNS)]
    online = {key: metrics.get(key.replace("trajectory/", "trajectory_online/")) for key, *_ in _COLUMNS[:3]}
    if any(value is not None for value in online.values()):
        lines.insert(1, Line(["ours, as placed"], online))
    columns = known(_COLUMNS, [line.values for line in lines])
    return transposed(metric_table([""], columns, lines, [run.provenance["data"]["name"]]))


def protocol_words(run: FinishedRun) -> str:
    """Describe how errors are measured."""
    config = run.provenance["config"].get("evaluation", {})
    statistic, num_frames = config.get("statistic", "mean"), run.metrics.get("trajectory/num_frames")
    return (
        f"Protocol {run.provenance['protocol']}: {statistic} distances, clouds placed by their points (ICP) or by the "
        f"path ({config.get('alignment')}); rendered at each one's own poses. {num_frames} frames with truth. Raw "
        "prior: the same predictions without mapping."
    )


def loops(run: FinishedRun) -> tuple[Table, str, list[str]] | None:
    """Describe loop candidates: counts of outcomes, their effect, and each in words; None without a back end."""
    if not run.loops:
        return None
    counts = Counter(map(loop_why, run.loops)).most_common()
    each = [loop_words(run, loop) for loop in run.loops[:MAX_LOOPS]]
    each += [f"and {len(run.loops) - MAX_LOOPS} more in loops.json"] if len(run.loops) > MAX_LOOPS else []
    outcomes = Table(("candidates", "outcome"), [(f"{count}", words) for words, count in counts])
    return outcomes, f"{run.metrics.get('loops/closures', 0)} closures moved poses and map.", each


def settings(again: Repeated) -> Table:
    """List the settings that differ from the defaults."""
    rows = [(key, _plain(value), _plain(default)) for key, value, default in again.differences]
    return Table(("setting", "here", "default"), rows)


def polished(run: FinishedRun) -> tuple[Table, str] | None:
    """Compare map and splats of `emgs polish` on the frames that it held out; None if it was not run."""
    path = run.folder / POLISH[1]
    if not path.is_file():
        return None
    with sound(f"{path} is not what emgs polish writes", "polish again"):
        found = json.loads(path.read_text(encoding="utf-8"))
        count, held = (int(found[f"polish/{name}"]) for name in ("num_splats", "num_held_out"))
        return polish_table(found), f"{count:,} splats; the {held} frames that are compared were not fitted."


def files(run: FinishedRun) -> Table:
    """List the files beside the page, with the programs that open them."""
    there = [(name, words) for name, words in FILES.items() if name == "report.html" or (run.folder / name).exists()]
    return Table(("file", "what it is; what opens it"), there)


def _plain(value: Any) -> str:
    if value is ...:
        return "not there"
    return ", ".join(map(str, value)) if isinstance(value, list) else "none" if value is None else str(value)
