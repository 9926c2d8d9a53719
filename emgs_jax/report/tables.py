"""Results as one row per estimate (CSV), as mean and spread over seeds (JSON), and as Markdown tables."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from emgs_jax.report.columns import (
    DASH,
    MAIN,
    PLACED,
    RENDERED,
    SHARE,
    Column,
    Line,
    Table,
    cell,
    csv_text,
    if_lacking,
    known,
    markdown,
    metric_table,
)
from emgs_jax.runs.results import Estimate

_PAPER_DATASETS = {"seven_scenes": "7-Scenes", "tum": "TUM"}
_PAPER_COLUMNS = (  # title, key, digits; the order of the paper's Table II
    ("Acc [m]", "reconstruction/accuracy_m", 3),
    ("Comp [m]", "reconstruction/completion_m", 3),
    ("ATE [m]", "trajectory/ate_{alignment}_m", 3),
    ("F1 [%]", "reconstruction/f1_20cm_percent", 1),
    ("Normals [%]", "reconstruction/normals_abs_cos_percent", 1),
    ("Scale [%]", "trajectory/scale_percent", 1),
)
SCALE_STD = (  # of a map in metres by `scale=` or a metric network
    Column("prior/scale_std_percent", "scale ± [%]", 1.0, 1, True),
    Column("trajectory/scale_off_std", "scale off [σ]", 1.0, 1, True),
)
COLUMNS = (
    MAIN[0]._replace(title="ATE Sim(3) [cm]"),
    Column("trajectory/ate_se3_m", "ATE SE(3) [cm]", 100.0, 2, True),
    SHARE,
    *MAIN[1:],
    *PLACED,
    *RENDERED,
    Column("trajectory/scale_percent", "scale [%]", 1.0, 1, False),
    *SCALE_STD,
    Column("time/seconds_per_frame", "s a frame", 1.0, 2, True),
)
_NOTES = """
Sequences × seeds: ours is the mean over sequences, ± the deviation over seeds. F1 at .2 m; Normals: mean |cos|; Scale:
100 · min(s, 1/s); the paper defines neither of the last two. **simulated**: the prior is disturbed ground truth, which
says nothing about a network and must not be compared with quoted rows. Quoted rows are not measured here and are means
over seq-01 of seven scenes (7-Scenes) and nine sequences of freiburg1 (TUM).
"""


@dataclass(frozen=True)
class Row:
    """Mean and spread over the seeds of one kind of estimate."""

    dataset: str
    variant: str
    kind: str
    prior: str | None
    is_simulated: bool
    protocol: str
    sequences: tuple[str, ...]  # averaged within each seed
    seeds: tuple[int, ...]  # with a result for each of the sequences
    values: dict[str, float | None]  # metric -> mean over the seeds; None if any seed lacks it
    spreads: dict[str, float | None]  # metric -> standard deviation over the seeds, None for fewer than two


def average(estimates: Iterable[Estimate], each_sequence: bool) -> list[Row]:
    """Average over seeds, in the order of the estimates: all sequences of a data set together, or each by itself.

    A seed counts only if it has a result for every sequence that any seed has, because means over different sequences
    are not comparable.
    """
    groups: dict[tuple, list[Estimate]] = defaultdict(list)
    for item in estimates:
        what = item.dataset, item.variant, item.kind, item.prior, item.is_simulated, item.protocol
        groups[(*what, item.sequence if each_sequence else None)].append(item)
    return [_row(what[:-1], members) for what, members in groups.items()]


def to_csv(estimates: Sequence[Estimate]) -> str:
    """Write one CSV line per estimate: its origin, then every metric."""
    names = ("dataset", "sequence", "variant", "kind", "seed", "prior", "is_simulated", "protocol", "revision")
    return csv_text([{name: getattr(item, name) for name in names} | item.values for item in estimates])


def paper_table(rows: Sequence[Row], published: Sequence[Mapping[str, Any]]) -> str:
    """Write rows over all sequences like the paper's Table II, in Markdown; empty if none is of its data sets.

    Quoted rows are `published`: method, source, protocol and the columns' values by data set.
    """
    methods: dict[tuple, dict[str, Row]] = defaultdict(dict)
    for row in rows:
        if row.dataset in _PAPER_DATASETS:
            methods[(f"{row.kind}, {row.variant}", source_of(row), row.protocol)][row.dataset] = row
    if not methods:
        return ""
    lines = []
    for what, members in methods.items():
        found = [(name, members[key]) for key, name in _PAPER_DATASETS.items() if key in members]
        runs = "; ".join(f"{name} {len(row.sequences)} × {len(row.seeds)}" for name, row in found)
        lines.append([*what, runs, *(text for key in _PAPER_DATASETS for text in _paper_cells(members.get(key)))])
    for row in published:
        cells = [DASH if value is None else f"{value:g}" for key in _PAPER_DATASETS for value in row[key]]
        lines.append([row["method"], f"quoted: {row['source']}", row["protocol"], DASH, *cells])
    titles = [f"{name}: {title}" for name in _PAPER_DATASETS.values() for title, _, _ in _PAPER_COLUMNS]
    return markdown(Table(["method", "source", "protocol", "sequences × seeds", *titles], lines)) + _NOTES


def full_table(rows: Sequence[Row]) -> str:
    """Write a line per row with the main metrics, in Markdown."""
    lines = []
    for row in rows:
        method = f"{row.kind}, {row.variant}"
        labels = [row.dataset, over(row.sequences), method, source_of(row), row.protocol, str(len(row.seeds))]
        lines.append(Line(labels, row.values, row.spreads, rivals=None))
    titles = ["data set", "sequence", "method", "source", "protocol", "seeds"]
    values = [row.values for row in rows]
    unknown = {*SCALE_STD} - {*known(SCALE_STD, values)}
    columns = [column for column in if_lacking(COLUMNS, values) if column not in unknown]
    return markdown(metric_table(titles, columns, lines, {row.dataset for row in rows}))


def over(sequences: Sequence[str]) -> str:
    """Name the sequence of a row, or the number of sequences that it averages."""
    return sequences[0] if len(sequences) == 1 else f"mean of {len(sequences)}"


def _row(what: tuple, members: list[Estimate]) -> Row:
    sequences = tuple(dict.fromkeys(item.sequence for item in members))
    found = {(item.sequence, item.seed): item.values for item in members}
    seeds = sorted({item.seed for item in members})
    seeds = tuple(seed for seed in seeds if all((sequence, seed) in found for sequence in sequences))
    values: dict[str, float | None] = {}
    spreads: dict[str, float | None] = {}
    for key in {key: None for item in members for key in item.values}:
        numbers = [[found[sequence, seed].get(key) for sequence in sequences] for seed in seeds]
        is_known = all(number is not None for line in numbers for number in line)
        means = [statistics.fmean(line) for line in numbers] if is_known else []
        values[key] = statistics.fmean(means) if means else None
        spreads[key] = statistics.stdev(means) if len(means) > 1 else None
    return Row(*what, sequences, seeds, values, spreads)


def source_of(row: Row) -> str:
    """Describe the source of the numbers in Markdown: measured or (in bold) simulated, and the prior."""
    label = "**simulated**" if row.is_simulated else "measured"
    return label if row.prior in (None, "simulated") else f"{label}, {row.prior}"


def _paper_cells(row: Row | None) -> list[str]:
    if row is None:
        return [DASH] * len(_PAPER_COLUMNS)
    alignment = row.protocol.rsplit("/", 1)[-1]
    keys = [(key.format(alignment=alignment), digits) for _, key, digits in _PAPER_COLUMNS]
    return [cell(row.values.get(key), row.spreads.get(key), 1.0, digits) for key, digits in keys]
