"""The images of finished runs, from the settings in their metrics.json."""

from collections.abc import Sequence
from pathlib import Path

from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emgs_jax.config.configure import build_dataset, message_of
from emgs_jax.data.joined import JoinedFrames
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.runs.finished_run import FinishedRun, read_run
from emgs_jax.runs.repeat import check_targets

CAMERA = "emgs_jax.live.camera.Camera"


def images_of(run: FinishedRun) -> tuple[ReadableFrames | None, str]:
    """Build the data set of a run, or return why there is none; ValueError if settings name code other than ours."""
    settings, count = run.provenance["config"], len(run.poses)
    check_targets(settings["dataset"])
    if settings["dataset"]["_target_"] == CAMERA:
        return None, "The images are not available: those of a camera are kept with dataset.record=true alone."
    try:
        dataset = build_dataset(OmegaConf.create(dict(settings)))
    except OmegaConfBaseException as error:  # a key that the settings of older code lack
        return None, f"The images are not available: the run is of another version ({str(error).splitlines()[0]})."
    except (ValueError, OSError, InstantiationException) as error:
        return None, f"The images are not available: {message_of(error)}{_where(settings['dataset'].get('root'))}."
    if len(dataset) != count:
        return None, f"The images are not available: there are {len(dataset)} now, and {count} were mapped."
    if dataset.fingerprint() != run.provenance["data"]["fingerprint"]:
        return None, "The images are not available: they are not those that were mapped."
    return dataset, ""


def _where(root: str | None) -> str:
    """Say where images that have gone must be; empty if their folder is there, or they have none."""
    if root is None or Path(root).expanduser().exists():
        return ""
    if Path(root).expanduser().is_absolute():
        return f"; the run read them from {root}: put them, or a link to them, there"
    return f"; the run read them from {root}, below the folder it was started in: repeat this command in that folder"


class ImagesOfRuns(JoinedFrames):
    """The images of the runs in some folders, one run after the other; ValueError if those of a run are gone.

    Those in the `repeated` rows are left out.
    """

    def __init__(self, runs: Sequence[str], has_truth: bool = True, repeated: Sequence[int] = ()) -> None:
        found = [images_of(read_run(Path(folder))) for folder in runs]
        for folder, (dataset, note) in zip(runs, found, strict=True):
            if dataset is None:
                raise ValueError(f"{folder}: {note}")
        super().__init__([dataset for dataset, _ in found], has_truth, repeated)
