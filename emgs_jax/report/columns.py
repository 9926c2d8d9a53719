"""Tables of results: the main metrics as columns in their unit, and writers for Markdown, terminals and CSV.

Pages write the same tables by `table` of web/parts.html.
"""

import csv
import io
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from emgs_jax.runs.provenance import OWN_UNITS, PLACED_PERCENT, ROWS

DASH = "–"


class Column(NamedTuple):
    """A metric as a column of a table."""

    key: str
    title: str
    factor: float
    digits: int
    is_lower_better: bool


SHARE = Column(PLACED_PERCENT, "placed [%]", 1.0, 1, False)  # of the frames that the errors are of
MAIN = (
    Column("trajectory/ate_sim3_m", "ATE [cm]", 100.0, 2, True),
    Column("reconstruction/accuracy_m", "accuracy [cm]", 100.0, 2, True),
    Column("reconstruction/completion_m", "completion [cm]", 100.0, 2, True),
    Column("reconstruction/f1_20cm_percent", "F1@.2 [%]", 1.0, 1, False),
    Column("reconstruction/f1_5cm_percent", "F1@.05 [%]", 1.0, 1, False),
    Column("reconstruction/normals_abs_cos_percent", "normals [%]", 1.0, 1, False),
)
BY_PATH = tuple(column._replace(title=f"path: {column.title}") for column in MAIN[1:])  # aligned by trajectory
PLACED = tuple(  # aligned by ICP
    column._replace(key=column.key.replace("/", "_icp/"), title=f"ICP: {column.title}") for column in MAIN[1:]
)
RENDERED = (  # at their own poses
    Column("rendering/coverage_percent", "coverage [%]", 1.0, 1, False),
    Column("rendering/worst_coverage_percent", "at worst [%]", 1.0, 1, False),
    Column("rendering/depth_l1_m", "depth error [cm]", 100.0, 2, True),
    Column("rendering/depth_within_5_percent", "within 5 % [%]", 1.0, 1, False),
    Column("rendering/psnr_db", "PSNR [dB]", 1.0, 1, False),
)


class Cell(NamedTuple):
    """A number or text in a table with a kind: `best`, or a CSS class; plain text is a str."""

    text: str
    kind: str = ""


class Table(NamedTuple):
    """Titles, and lines with as many cells."""

    titles: Sequence[str]
    lines: Sequence[Sequence[str | Cell]]


class Line(NamedTuple):
    """Metrics of one estimate."""

    labels: Sequence[str]  # its first cells
    values: Mapping[str, float | None]  # by key; None without a value
    spreads: Mapping[str, float | None] = {}
    rivals: Hashable = ()  # equal for all lines that compete; None: competes with none


def known(columns: Iterable[Column], rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    """Keep the columns in which some row has a value."""
    return [column for column in if_lacking(columns, rows) if any(row.get(column.key) is not None for row in rows)]


def if_lacking(columns: Iterable[Column], rows: Iterable[Mapping[str, Any]]) -> list[Column]:
    """Keep the share of placed frames only if some row lacks a frame."""
    is_whole = all(row.get(SHARE.key) in (None, 100) for row in rows)
    return [column for column in columns if column != SHARE or not is_whole]


def in_unit(columns: Iterable[Column], data: Collection[str]) -> list[Column]:
    """Give columns of lengths their unit for these data sets: centimetres, or the truth's own unit."""
    own = [name in OWN_UNITS for name in data]
    unit = "cm" if not any(own) else ".01 units" if all(own) else "cm or .01 units"
    return [column._replace(title=column.title.replace("[cm]", f"[{unit}]")) for column in columns]


def metric_table(
    titles: Sequence[str], columns: Sequence[Column], lines: Sequence[Line], data: Collection[str]
) -> Table:
    """Lay out metrics below the titles of the labels and of the columns; the best of several rivals is marked.

    `data` names the data sets of the lines, which determine the unit of lengths.
    """
    numbers: dict[tuple, list[float]] = {}
    for line in lines:
        for column in columns:
            value = line.values.get(column.key)
            if value is not None and line.rivals is not None:
                numbers.setdefault((line.rivals, column), []).append(value)
    best = {
        what: (min if what[1].is_lower_better else max)(values) for what, values in numbers.items() if len(values) > 1
    }

    def number(line: Line, column: Column) -> Cell:
        value = line.values.get(column.key)
        text = cell(value, line.spreads.get(column.key), column.factor, column.digits)
        return Cell(text, "best" if value is not None and value == best.get((line.rivals, column)) else "")

    laid_out = [[*line.labels, *(number(line, column) for column in columns)] for line in lines]
    return Table([*titles, *(column.title for column in in_unit(columns, data))], laid_out)


def transposed(table: Table) -> Table:
    """Swap lines and columns; the first labels become titles."""
    top, *lines = zip(table.titles, *table.lines, strict=True)
    return Table([cell_text(title) for title in top], lines)


def cell(mean: float | None, spread: float | None, factor: float, digits: int, sign: str = "") -> str:
    """Write mean ± spread; a dash for a missing mean or NaN. `sign="+"` also marks positive numbers."""
    if mean is None or mean != mean:
        return DASH
    return f"{factor * mean:{sign}.{digits}f}" + ("" if spread is None else f" ± {factor * spread:.{digits}f}")


def cell_text(content: str | Cell) -> str:
    """Return the text of a cell, without its kind."""
    return content.text if isinstance(content, Cell) else content


def markdown(table: Table) -> str:
    """Write a table in Markdown; the best are bold."""

    def text(content: str | Cell) -> str:
        mark = "**" if isinstance(content, Cell) and content.kind == "best" else ""
        return f"{mark}{cell_text(content)}{mark}"

    rows = [table.titles, ["---"] * len(table.titles), *([text(content) for content in line] for line in table.lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def aligned(table: Table) -> str:
    """Write a table for a terminal: labels aligned left, the rest right, a line below the titles."""
    texts = [[cell_text(content) for content in line] for line in (table.titles, *table.lines)]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    rows = ["  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in texts]
    return "\n".join([rows[0], "─" * max(map(len, rows)), *rows[1:]])


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write CSV with a line for each row; missing values are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def lines_of(metrics: Mapping[str, Any], columns: Sequence[Column]) -> list[Line]:
    """Return a line for each estimate of `ROWS` that has one of these metrics."""
    return [
        Line([name], {column.key: metrics.get(prefix + column.key) for column in columns}, rivals=None)
        for prefix, name in ROWS.items()
        if any(prefix + column.key in metrics for column in columns)
    ]
