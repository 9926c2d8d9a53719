"""Columns of tables: the main metrics with their units, numbers as text, Markdown."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

DASH = "–"


class Column(NamedTuple):
    """A metric as people read it."""

    key: str
    title: str
    factor: float
    digits: int
    is_lower_better: bool


MAIN = (
    Column("trajectory/ate_sim3_m", "ATE [cm]", 100.0, 2, True),
    Column("reconstruction/accuracy_m", "accuracy [cm]", 100.0, 2, True),
    Column("reconstruction/completion_m", "completion [cm]", 100.0, 2, True),
    Column("reconstruction/f1_20cm_percent", "F1@.2 [%]", 1.0, 1, False),
    Column("reconstruction/f1_5cm_percent", "F1@.05 [%]", 1.0, 1, False),
    Column("reconstruction/normals_abs_cos_percent", "normals [%]", 1.0, 1, False),
)

PLACED = (  # by their points
    Column("reconstruction_icp/accuracy_m", "ICP: accuracy [cm]", 100.0, 2, True),
    Column("reconstruction_icp/completion_m", "ICP: completion [cm]", 100.0, 2, True),
    Column("reconstruction_icp/f1_20cm_percent", "ICP: F1@.2 [%]", 1.0, 1, False),
    Column("reconstruction_icp/f1_5cm_percent", "ICP: F1@.05 [%]", 1.0, 1, False),
    Column("reconstruction_icp/normals_abs_cos_percent", "ICP: normals [%]", 1.0, 1, False),
)
BY_PATH = tuple(column._replace(title=f"path: {column.title}") for column in MAIN[1:])  # beside those by points
RENDERED = (  # at their own poses
    Column("rendering/coverage_percent", "coverage [%]", 1.0, 1, False),
    Column("rendering/worst_coverage_percent", "at worst [%]", 1.0, 1, False),
    Column("rendering/depth_l1_m", "depth error [cm]", 100.0, 2, True),
    Column("rendering/depth_within_5_percent", "within 5 % [%]", 1.0, 1, False),
    Column("rendering/psnr_db", "PSNR [dB]", 1.0, 1, False),
)


def cell(mean: float | None, spread: float | None, factor: float, digits: int, sign: str = "") -> str:
    """Mean ± spread as text; a dash where there is no mean, NaN included. `sign="+"` writes it of positive ones too."""
    if mean is None or mean != mean:
        return DASH
    return f"{factor * mean:{sign}.{digits}f}" + ("" if spread is None else f" ± {factor * spread:.{digits}f}")


def markdown(titles: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table."""
    rows = [titles, ["---"] * len(titles), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"
