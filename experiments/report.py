"""Write the page of a run anew: `python -m experiments.report FOLDER`; a run writes it at its end by itself."""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.io.files import check_writable
from emgs_jax.report.finished_run import read_run
from emgs_jax.report.page import write_report
from emgs_jax.report.run_images import images_of

from .command import command, first_words


def report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run; without its images where they are gone."""
    run = read_run(folder)
    check_writable(folder, f"folder={folder}")
    dataset, note = images_of(run)
    path = write_report(run, dataset, note)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB" + (f"\n{note}" if note else ""))
    return path


@command("report", first_words("folder"))
def main(config: DictConfig) -> None:
    """Write the page, and say where it is."""
    report(Path(str(config.folder)))


if __name__ == "__main__":
    main()
