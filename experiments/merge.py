"""Merge finished runs: `python -m experiments.merge FOLDER FOLDER out=FOLDER`."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from emgs_jax.report.page import write_report
from emgs_jax.report.printout import last_words, metrics_table
from emgs_jax.runs.finished_run import REPORT_FILE, read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.merging import merge

from .command import command, first_words


def merge_runs(config: DictConfig) -> tuple[dict[str, Any], list[str]]:
    """Check and merge the runs of a config; return metrics and notes."""
    folders, out = [Path(str(folder)) for folder in config.folders], Path(str(config.out))
    if len(folders) < 2:
        raise ValueError(f"there is one run to merge, {folders[0]}: give two or more: emgs merge RUN RUN out=FOLDER")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise ValueError(f"a run is named twice in {', '.join(map(str, folders))}: give each once")
    if out.exists():
        raise ValueError(f"out={out} is there already: give a folder that is not")
    metrics, notes = merge(folders, out, config.truth)
    merged = read_run(out)
    write_report(merged, *images_of(merged))
    return metrics, notes


@command("merge", first_words("folders", is_list=True))
def main(config: DictConfig) -> None:
    metrics, notes = merge_runs(config)
    print("\n".join(notes) if notes else "all runs are joined")
    if "trajectory/num_frames" in metrics:
        print(metrics_table(metrics))
    print(f"{last_words(metrics)}everything is in {config.out}, {REPORT_FILE} shows it")


if __name__ == "__main__":
    main()
