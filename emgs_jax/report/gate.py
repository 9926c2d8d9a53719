"""A committed baseline: results must not get worse than it by more than a tolerance."""

import itertools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from emgs_jax.io.files import atomic_write
from emgs_jax.report.tables import Row
from emgs_jax.runs.results import Estimate, sound

GATE_FORMAT = 1
# By how much a metric of a new baseline may get worse, at least; which direction is better.
TOLERANCES = {
    "trajectory/ate_sim3_m": {"direction": "lower", "tolerance": 0.005},
    "trajectory/ate_se3_m": {"direction": "lower", "tolerance": 0.005},
    "reconstruction/accuracy_m": {"direction": "lower", "tolerance": 0.005},
    "reconstruction/completion_m": {"direction": "lower", "tolerance": 0.005},
    "reconstruction/f1_20cm_percent": {"direction": "higher", "tolerance": 1.0},
    "reconstruction/f1_5cm_percent": {"direction": "higher", "tolerance": 3.0},
    "reconstruction/normals_abs_cos_percent": {"direction": "higher", "tolerance": 2.0},
}
_DEVIATIONS = 4.0  # of the effect of rounding on a mean, because other machines compare with a baseline
_FEWEST_PAIRS = 5


def rounding_tolerances(
    tolerances: Mapping[str, Mapping[str, Any]],
    estimates: Iterable[Estimate],
    rounded: Iterable[Estimate],
    num_seeds: int,
) -> dict[str, dict[str, Any]]:
    """Widen tolerances by the effect of rounding alone on a mean over `num_seeds` seeds.

    Seeds differ much more from each other than one seed does between machines, and a gate compares the same seeds. So
    what counts is the root mean square of the differences, job by job.

    Args:
        estimates: of some seeds, preferably more than those of the baseline.
        rounded: of the same jobs, computed with other instructions of the processor.
    """

    def by_job(some: Iterable[Estimate]) -> dict[tuple, dict[str, float]]:
        ours = (item for item in some if item.kind == "ours")
        return {(one.dataset, one.sequence, one.variant, one.protocol, one.seed): one.values for one in ours}

    first, again = by_job(estimates), by_job(rounded)
    pairs = [(first[job], again[job]) for job in first if job in again]
    if len(pairs) < _FEWEST_PAIRS:
        raise ValueError(
            f"{len(pairs)} results are there with both roundings, at least {_FEWEST_PAIRS} are needed for tolerances: "
            "evaluate seeds=[0,1,2,3,4,5,6,7,8,9] into both folders"
        )
    found = {}
    for key, rule in tolerances.items():
        changes = [there[key] - here[key] for here, there in pairs if key in here and key in there]
        least = _DEVIATIONS * math.sqrt(sum(change**2 for change in changes) / max(len(changes), 1) / num_seeds)
        found[key] = {**rule, "tolerance": max(float(rule["tolerance"]), float(f"{least:.2g}"))}
    return found


def write_gate(path: str | os.PathLike, rows: Sequence[Row], tolerances: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the mean of each metric of `tolerances` for our own rows; comments at the top of the old file stay.

    Args:
        tolerances: metric -> {direction: whether lower or higher is better, tolerance: by how much it may get worse}.
    """
    baseline = {}
    for row in rows:
        if row.kind == "ours" and row.seeds:
            values = {key: row.values.get(key) for key in tolerances}
            metrics = {key: {"value": one, **tolerances[key]} for key, one in values.items() if one is not None}
            baseline[_name(row)] = {"protocol": row.protocol, "seeds": list(row.seeds), "metrics": metrics}
    if not baseline:
        raise ValueError(f"{path} is not written: there is no result of ours to take a baseline from")
    before = Path(path).read_text(encoding="utf-8").splitlines(keepends=True) if Path(path).is_file() else []
    with atomic_write(path, "w") as handle:
        handle.writelines(itertools.takewhile(lambda line: line.startswith("#"), before))
        yaml.safe_dump({"format": GATE_FORMAT, "baseline": baseline}, handle, sort_keys=False)


def read_gate(path: str | os.PathLike) -> dict[str, Any]:
    """Read a baseline, by name of its row, from YAML or JSON; raise ValueError if it is unusable."""
    remedy = "write one with python -m experiments.evaluate … write_gate=FILE"
    if not Path(path).is_file():
        raise ValueError(f"gate={path} is no file: {remedy}")
    with sound(f"gate={path} is no baseline", remedy):
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        if content["format"] != GATE_FORMAT:
            raise ValueError(f"format {content['format']}, not {GATE_FORMAT}")
        for entry in content["baseline"].values():
            for key, rule in entry["metrics"].items():
                if rule["direction"] not in ("lower", "higher") or not float(rule["tolerance"]) >= 0:
                    raise ValueError(f"{key} needs direction: lower or higher, and a tolerance of 0 or more")
                float(rule["value"])
            entry["protocol"], [int(seed) for seed in entry["seeds"]]
    return content["baseline"]


def regressions(baseline: Mapping[str, Any], rows: Sequence[Row]) -> list[str]:
    """Describe each metric that is worse than the baseline allows, or missing, in a line."""
    found = {(_name(row), row.protocol): row for row in rows if row.kind == "ours"}
    lines = []
    for name, entry in baseline.items():
        row = found.get((name, entry["protocol"]))
        if row is None or list(row.seeds) != list(entry["seeds"]):
            seeds = "no result" if row is None else f"results of the seeds {list(row.seeds)}"
            lines.append(f"{name}: {seeds} under {entry['protocol']}, the baseline has {entry['seeds']}")
            continue
        for key, rule in entry["metrics"].items():
            value, tolerance = row.values.get(key), float(rule["tolerance"])
            loss = None if value is None else (value - rule["value"]) * (1 if rule["direction"] == "lower" else -1)
            if loss is None or not loss <= tolerance:
                shown = "missing" if value is None else f"{value:.6g}"
                allowed = f"{rule['direction']} is better, tolerance {tolerance:g}"
                lines.append(f"{name}: {key} is {shown}, baseline {rule['value']:.6g} ({allowed})")
    return lines


def _name(row: Row) -> str:
    return f"{row.dataset}/{row.sequences[0]}/{row.variant}"
