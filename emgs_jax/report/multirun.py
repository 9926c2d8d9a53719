"""One table of many runs, those of `emgs run -m`: the settings of each, and its results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from emgs_jax.io.files import write_file
from emgs_jax.report.columns import MAIN, SHARE, Line, Table, csv_text, known, markdown, metric_table
from emgs_jax.runs.results import METRICS_FILE, read_metrics

OVERRIDES = Path(".hydra", "overrides.yaml")  # the words of a run, as stored by Hydra


def runs_of(folder: Path) -> list[Path]:
    """Find the finished runs below a folder, in the order of their numbers."""
    found = (path.parent for path in folder.glob(f"*/{METRICS_FILE}"))
    return sorted(found, key=lambda path: (len(path.name), path.name))


def read_multirun(folder: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Read the finished runs below a folder.

    Returns:
        The keys that differ between runs, and a flat row for each run: its folder, the values of these keys as given
        ("" if not given), the data set, then all metrics.
    """
    folders = runs_of(folder)
    given = [dict(word.partition("=")[::2] for word in OmegaConf.load(path / OVERRIDES)) for path in folders]
    keys = [key for key in dict.fromkeys(key for words in given for key in words) if _differs(key, given)]
    rows = []
    for path, words in zip(folders, given, strict=True):
        metrics = read_metrics(path / METRICS_FILE)
        about = {"run": path.name} | {key: words.get(key, "") for key in keys}
        rows.append(about | {"data": metrics.pop("provenance")["data"]["name"]} | metrics)
    return keys, rows


def _differs(key: str, given: Sequence[Mapping[str, str]]) -> bool:
    return len({words.get(key) for words in given}) > 1


def table_of(keys: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> Table:
    """Lay out the main metrics of all runs; mark the best of each data set."""
    lines = [Line([row["run"], *(row[key] for key in keys)], row, rivals=row["data"]) for row in rows]
    return metric_table(["run", *keys], known((MAIN[0], SHARE, *MAIN[1:]), rows), lines, {row["data"] for row in rows})


def write_multirun(folder: Path) -> Table:
    """Write runs.md with the main metrics and runs.csv with all of them; return the table."""
    keys, rows = read_multirun(folder)
    table = table_of(keys, rows)
    write_file(folder / "runs.md", markdown(table))
    write_file(folder / "runs.csv", csv_text(rows))
    return table
