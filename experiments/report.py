"""Write a run's page again, or a table of many runs: `python -m experiments.report FOLDER`."""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.io.files import check_writable
from emgs_jax.report.columns import aligned
from emgs_jax.report.multirun import runs_of, write_multirun
from emgs_jax.report.page import write_report
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.results import METRICS_FILE

from .command import command, first_words


def report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run, without images that are gone."""
    run = read_run(folder)
    check_writable(folder, f"folder={folder}")
    dataset, note = images_of(run)
    path = write_report(run, dataset, note)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB" + (f"\n{note}" if note else ""))
    return path


def tabulate(folder: Path) -> None:
    """Print and write the table of the runs below a folder."""
    check_writable(folder, f"folder={folder}")
    print(aligned(write_multirun(folder)))
    print(f"{folder / 'runs.md'} has this table, {folder / 'runs.csv'} all metrics")


@command("report", first_words("folder"))
def main(config: DictConfig) -> None:
    folder = Path(str(config.folder))
    is_multirun = not (folder / METRICS_FILE).exists() and bool(runs_of(folder))
    tabulate(folder) if is_multirun else report(folder)


if __name__ == "__main__":
    main()
