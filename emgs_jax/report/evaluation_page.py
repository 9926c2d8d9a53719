"""report.html of an evaluation: outcome of every run, ours beside raw prior and baselines, and the gate."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from emgs_jax.report.columns import MAIN, Cell, Line, Table, known, metric_table
from emgs_jax.report.html import MAX_LINES, Head, link, page, picture, thumbnails, write_page
from emgs_jax.report.tables import COLUMNS, Row, over
from emgs_jax.runs.finished_run import REPORT_FILE
from emgs_jax.runs.provenance import PLACED_PERCENT, RAW_PRIOR, length_words
from emgs_jax.runs.results import METRICS_FILE, Estimate, read_metrics


class JobLine(NamedTuple):
    """A run of an evaluation: its name, its folder, and why it has no result ("" if it has one)."""

    name: str
    folder: Path
    missing: str


class Found(NamedTuple):
    """Outcome of an evaluation."""

    jobs: Sequence[JobLine]
    rows: Sequence[Row]
    estimates: Sequence[Estimate]
    gate: str | None = None  # the file of the baseline
    regressions: Sequence[str] = ()  # metrics that are worse than the gate allows, a line each


def write_evaluation_page(out: Path, found: Found, command: str) -> Path:
    """Write report.html into the folder of an evaluation; `command` repeats it, "" if unknown."""
    protocols, revisions = (
        sorted({str(getattr(item, name)) for item in found.estimates}) for name in ("protocol", "revision")
    )
    about = f"protocol {', '.join(protocols)}; commit {', '.join(text[:12] for text in revisions)}" if protocols else ""
    title, is_simulated = out.resolve().name, any(item.is_simulated for item in found.estimates)
    sources = sorted({(item.dataset, item.prior) for item in found.estimates if item.prior is not None})
    head = Head(f"{title}: evaluation", "Evaluation", title, *verdict(found), is_simulated, [about], command, sources)
    shown = found.jobs[:MAX_LINES]
    more = f"and {len(found.jobs) - len(shown)} more runs" if len(found.jobs) > len(shown) else ""
    values = {"runs": _runs(out, shown), "more": more, "errors": _errors(found.rows), "max_lines": MAX_LINES}
    return write_page(out, page("evaluation.html", head, found=found, **values))


def verdict(found: Found) -> tuple[str, str]:
    """Judge as `good`, `mixed`, `bad` or `unknown`, and count the runs that are finished and better than the raw prior.

    Bad: a run is unfinished or worse than the gate allows. Mixed: the path of some run is worse than the prior's.
    """
    done = sum(not job.missing for job in found.jobs)
    words = f"{done} of {len(found.jobs)} runs are finished"
    values = {(item.folder, item.kind): item.values.get(MAIN[0].key) for item in found.estimates}
    pairs = [(values.get((job.folder, "ours")), values.get((job.folder, "raw prior"))) for job in found.jobs]
    pairs = [pair for pair in pairs if None not in pair]
    better = sum(ours < raw for ours, raw in pairs)
    if pairs:
        words += f"; the path is nearer to the true one than the prior's own in {better} of {len(pairs)}"
    if found.gate is not None:
        words += f"; {len(found.regressions) or 'nothing'} is worse than the gate allows"
    if found.regressions or done < len(found.jobs):
        return "bad", f"{words}."
    return ("unknown" if not pairs else "good" if better == len(pairs) else "mixed"), f"{words}."


def run_facts(metrics: Mapping[str, Any]) -> str:
    """Describe a run in one line: the path's error beside the prior's, and the frames."""
    ours, raw = (metrics.get(prefix + MAIN[0].key) for prefix in ("", RAW_PRIOR))
    block = metrics.get("provenance", {})
    share = metrics.get(PLACED_PERCENT, 100)
    of = "" if share == 100 else f" over {share:.0f} % of the frames"
    lacking = "no placed frame has a true pose" if PLACED_PERCENT in metrics else "no ground truth"
    words = [lacking] if ours is None else [f"path off by {length_words(ours, block)}{of}"]
    if ours is not None and raw is not None:
        words[0] += f" (prior alone: {length_words(raw, block)})"
    counts = {status: metrics.get(f"frames/{status}") for status in ("tracked", "degraded", "lost", "skipped")}
    return ", ".join([*words, *(f"{count} {status}" for status, count in counts.items() if count)])


def _runs(out: Path, jobs: Sequence[JobLine]) -> Table:
    """Write a line for each run: picture, name, folder, and its result or why it has none."""
    lines = []
    for job, content in zip(jobs, thumbnails([job.folder / "overview.png" for job in jobs]), strict=True):
        missing = Cell(f"not finished: {job.missing}", "text bad")
        what = missing if job.missing else run_facts(read_metrics(job.folder / METRICS_FILE))
        links = link(out, job.folder / REPORT_FILE, "report"), link(out, job.folder, "folder")
        name = Markup("{}<br>{}").format(job.name, Markup(" · ").join(filter(None, links)))
        lines.append([picture(content, f"the map of {job.name}"), name, what])
    return Table(("", "run", "what it came to"), lines)


def _errors(rows: Sequence[Row]) -> Table:
    """Lay out ours, the raw prior and baselines, one below the other; mark the best of comparable values."""
    lines = []
    for row in rows:
        label = "simulated" if row.is_simulated else "measured"
        labels = [row.dataset, over(row.sequences), row.variant, row.kind, label, row.protocol, str(len(row.seeds))]
        rivals = row.dataset, row.sequences, row.protocol, row.is_simulated
        lines.append(Line(labels, row.values, row.spreads, rivals))
    titles = ("data set", "sequence", "setting", "", "source", "protocol", "seeds")
    columns = known(COLUMNS, [row.values for row in rows])
    table = metric_table(titles, columns, lines, {row.dataset for row in rows})
    return table._replace(lines=table.lines[:MAX_LINES])
