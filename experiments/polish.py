"""Fit sharp splats to a finished run: `python -m experiments.polish FOLDER`; splats.ply, polish.json and polish.png."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import build
from emgs_jax.io.files import check_writable, owned
from emgs_jax.report.page import write_report
from emgs_jax.report.printout import polish_lines
from emgs_jax.runs.finished_run import SPLATS_FILE, read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.polished import polish

from .command import command, first_words


def polish_run(config: DictConfig) -> dict[str, Any]:
    """Fit splats to the images of `config.folder`; return the content of polish.json."""
    if not config.polish:
        raise ValueError("polish=none has no settings to fit splats by: choose polish=default")
    fitting, run = build(config, "polish"), read_run(Path(str(config.folder)))
    dataset, note = images_of(run)
    if dataset is None:
        raise ValueError(f"{note} They are what splats are fitted to.")
    check_writable(run.folder, f"folder={run.folder}")
    settings = OmegaConf.create(dict(run.provenance["config"]))
    with owned(run.folder):
        found = polish(run, dataset, fitting, build(settings, "densify").in_unit(run.metre))
        write_report(run, dataset)
    return found


@command("polish", first_words("folder"))
def main(config: DictConfig) -> None:
    print("\n".join(polish_lines(polish_run(config))))
    print(f"everything is in {config.folder}, {SPLATS_FILE} has the splats")


if __name__ == "__main__":
    main()
