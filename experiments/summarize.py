"""Mean and spread over runs: `python -m experiments.summarize FOLDER…` prints their metrics as a Markdown table."""

import argparse
import json
import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any

COLUMNS = {
    "trajectory/ate_sim3_m": ("ATE Sim(3) [cm]", 100.0),
    "trajectory/ate_se3_m": ("ATE SE(3) [cm]", 100.0),
    "reconstruction/accuracy_m": ("Acc [cm]", 100.0),
    "reconstruction/completion_m": ("Comp [cm]", 100.0),
    "reconstruction/f1_20cm_percent": ("F1@.2 [%]", 1.0),
    "reconstruction/f1_5cm_percent": ("F1@.05 [%]", 1.0),
    "reconstruction/normals_abs_cos_percent": ("Normals [%]", 1.0),
}


def read_runs(folders: list[str]) -> list[dict[str, Any]]:
    """Every metrics.json below the folders, in order of their paths."""
    paths = [path for folder in folders for path in sorted(Path(folder).rglob("metrics.json"))]
    if not paths:
        raise SystemExit(f"error: no metrics.json below {', '.join(folders)}: run python -m experiments.run first")
    return [json.loads(path.read_text()) for path in paths]


def row_name(metrics: dict[str, Any]) -> str:
    """What is the same for the seeds of one row: data, prior and the readings that make a preset."""
    config = metrics["provenance"]["config"]
    preset = "paper" if config["slam"]["initialization"] == "merged" else "default"
    dataset = config["dataset"]["_target_"].split(".")[-2]
    level = config["prior"].get("level")
    prior = config["prior"]["_target_"].split(".")[-2] + ("" if level is None else f" {level:g}")
    features = metrics["provenance"]["prior"]["settings"].get("features")
    prior += "" if features is None else f" + {features['model']['name']}"
    return f"{dataset}, {prior}, {preset}"


def cell(runs: list[dict[str, Any]], key: str, factor: float) -> str:
    """Mean ± standard deviation over the runs; a dash where a run has no value."""
    values = [run.get(key) for run in runs]
    if any(value is None for value in values):
        return "–"
    scaled = [factor * value for value in values]
    spread = f" ± {statistics.stdev(scaled):.1f}" if len(scaled) > 1 else ""
    return f"{statistics.fmean(scaled):.1f}{spread}"


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: for every kind of run one line of ours and one of the prior without mapping."""
    groups = defaultdict(list)
    for run in runs:
        groups[row_name(run)].append(run)
    titles = ["data, prior, preset", "", "runs", *(title for title, _ in COLUMNS.values())]
    lines = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for name, members in groups.items():
        for kind, prefix in (("ours", ""), ("raw prior", "raw_prior/")):
            cells = [cell(members, prefix + key, factor) for key, (_, factor) in COLUMNS.items()]
            lines.append("| " + " | ".join([name, kind, str(len(members)), *cells]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Read the folders of the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", help="output folders of experiments.run, or folders that hold some")
    print(table(read_runs(parser.parse_args().folders)))


if __name__ == "__main__":
    main()
