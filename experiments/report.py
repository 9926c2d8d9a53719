"""Write the page of a run anew: `python -m experiments.report FOLDER`; a run writes it at its end by itself."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emgs_jax.config.configure import build_dataset, message_of
from emgs_jax.config.overrides import KEY, quoted
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.io.files import check_writable
from emgs_jax.report.page import write_report
from emgs_jax.report.recorded_run import RecordedRun, read_run
from emgs_jax.report.repeat import check_targets

from .command import command


def report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run; without its images where they are gone."""
    run = read_run(folder)
    check_writable(folder, f"folder={folder}")
    dataset, note = images_of(run)
    path = write_report(run, dataset, note)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB" + (f"\n{note}" if note else ""))
    return path


def images_of(run: RecordedRun) -> tuple[ReadableFrames | None, str]:
    """The data set of a run, or why there is none; raises ValueError where settings name other code than ours."""
    settings, count = run.provenance["config"], len(run.poses)
    check_targets(settings["dataset"])
    try:
        dataset = build_dataset(OmegaConf.create(dict(settings)))
    except OmegaConfBaseException as error:  # a key of ours that the settings of older code do not have
        return None, f"The images are not shown: the run is of another version ({str(error).splitlines()[0]})."
    except (ValueError, OSError) as error:
        return None, f"The images are not shown: {message_of(error)}"
    if len(dataset) != count:
        return None, f"The images are not shown: there are {len(dataset)} now, and {count} were mapped."
    if dataset.fingerprint() != run.provenance["data"]["fingerprint"]:
        return None, "The images are not shown: they are not those that were mapped."
    return dataset, ""


def positional(arguments: list[str]) -> list[str]:
    """A first word that is no override is the folder."""
    is_folder = bool(arguments) and not arguments[0].startswith("-") and KEY.match(arguments[0]) is None
    return [f"folder={quoted(arguments[0])}", *arguments[1:]] if is_folder else arguments


@command("report", positional)
def main(config: DictConfig) -> None:
    """Write the page, and say where it is."""
    report(Path(str(config.folder)))


if __name__ == "__main__":
    main()
