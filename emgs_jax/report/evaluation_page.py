"""report.html of an evaluation: what became of every run, ours beside the prior alone and the baselines, the gate."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

from emgs_jax.report.columns import MAIN
from emgs_jax.report.page_words import command_line, first_words, quiet, section, table
from emgs_jax.report.recorded_run import REPORT_FILE
from emgs_jax.report.results import METRICS_FILE, Estimate, read_metrics
from emgs_jax.report.table_page import (
    MAX_LINES,
    best_of,
    link,
    number,
    picture,
    rows_of,
    run_facts,
    texts,
    thumbnails,
    write_page,
)
from emgs_jax.report.tables import COLUMNS, Row

_FILES = (
    ("results.csv", "a line for each estimate with every metric"),
    ("results.json", "means and deviations, and what is missing"),
    ("results.md", "the tables as text"),
)


class JobLine(NamedTuple):
    """A run of an evaluation: its name, its folder, and why it has no result ("" where it has one)."""

    name: str
    folder: Path
    missing: str


class Found(NamedTuple):
    """Outcome of an evaluation.

    Args:
        jobs: all of its runs.
        rows: for the table of errors.
        estimates: that the rows are made from.
        gate: the file that was compared with; None without one.
        regressions: metrics that are worse than the gate allows, a line each.
    """

    jobs: Sequence[JobLine]
    rows: Sequence[Row]
    estimates: Sequence[Estimate]
    gate: str | None = None
    regressions: Sequence[str] = ()


def write_evaluation_page(out: Path, found: Found, command: str) -> Path:
    """Write report.html into the folder of an evaluation; `command` repeats it, "" where nobody knows."""
    protocols, revisions = (
        sorted({str(getattr(item, name)) for item in found.estimates}) for name in ("protocol", "revision")
    )
    about = f"protocol {', '.join(protocols)}; commit {', '.join(text[:12] for text in revisions)}" if protocols else ""
    title, is_simulated = out.resolve().name, any(item.is_simulated for item in found.estimates)
    head = first_words("Evaluation", title, *verdict(found), is_simulated) + quiet(about)
    parts = [section("Runs", _jobs(out, found.jobs))]
    if found.rows:
        parts.append(section("Errors: means over the seeds", _errors(found.rows)))
    if found.gate is not None:
        lines = "".join(f"<li>{escape(line)}</li>" for line in found.regressions[:MAX_LINES])
        parts.insert(0, section(f"Gate {found.gate}", f"<ul>{lines}</ul>" if lines else "<p>Nothing is worse.</p>"))
    parts.append(section("Files", table(("file", "what it is"), _FILES)))
    names = sorted({(item.dataset, item.prior) for item in found.estimates if item.prior is not None})
    return write_page(out, f"{title}: evaluation", head + (command_line(command) if command else ""), parts, names)


def verdict(found: Found) -> tuple[str, str]:
    """`good`, `mixed`, `bad` or `unknown`, and how many runs are finished and better than the prior alone.

    Bad: something is not finished or worse than the gate allows. Mixed: the path of some run is worse than the prior's.
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


def _jobs(out: Path, jobs: Sequence[JobLine]) -> str:
    """A line for each run: picture, name, where it lies, what it came to or why not."""
    lines, shown = [], jobs[:MAX_LINES]
    for job, content in zip(shown, thumbnails([job.folder / "overview.png" for job in shown]), strict=True):
        if job.missing:
            what = f'<td class="text bad">not finished: {escape(job.missing)}</td>'
        else:
            what = texts([run_facts(read_metrics(job.folder / METRICS_FILE))])
        where = (link(out, job.folder / REPORT_FILE, "report"), link(out, job.folder, "folder"))
        name = f'<td class="text">{escape(job.name)}<br>{" · ".join(filter(None, where))}</td>'
        lines.append(f"<td>{picture(content, f'the map of {job.name}')}</td>{name}{what}")
    more = f"and {len(jobs) - len(shown)} more runs" if len(jobs) > len(shown) else ""
    return rows_of(("", "run", "what it came to"), (), lines) + quiet(more)


def _comparable(row: Row) -> tuple:
    """Return the values that two rows must share to be compared with each other."""
    return row.dataset, row.sequences, row.protocol, row.is_simulated


def _errors(rows: Sequence[Row]) -> str:
    """Ours, the raw prior and baselines one below the other; the best on the same data is marked."""
    columns = [column for column in COLUMNS if any(row.values.get(column.key) is not None for row in rows)]
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(_comparable(row), []).append(row)
    best = {
        what: [best_of((row.values.get(column.key) for row in members), column) for column in columns]
        for what, members in groups.items()
    }
    lines = []
    for row in rows[:MAX_LINES]:
        sequences = row.sequences[0] if len(row.sequences) == 1 else f"mean of {len(row.sequences)}"
        label = "simulated" if row.is_simulated else "measured"
        line = texts([row.dataset, sequences, row.variant, row.kind, label, row.protocol, str(len(row.seeds))])
        for column, top in zip(columns, best[_comparable(row)], strict=True):
            line += number(row.values.get(column.key), column, top, row.spreads.get(column.key))
        lines.append(line)
    titles = ("data set", "sequence", "setting", "", "source", "protocol", "seeds")
    return rows_of(titles, [column.title for column in columns], lines)
