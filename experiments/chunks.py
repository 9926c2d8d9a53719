"""A long walk in chunks: overlapping runs, started by Hydra's launchers and joined like those of `emgs merge`."""

import copy
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, read_write
from tqdm import tqdm

from emgs_jax.config.configure import build, message_of
from emgs_jax.config.overrides import written
from emgs_jax.data.base import Dataset
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.intrinsics import Pictures, from_numbers
from emgs_jax.data.readable import files_of_masks, fingerprint_with_masks
from emgs_jax.io.files import owned, write_json
from emgs_jax.report.page import write_report
from emgs_jax.runs.files import claim_folder
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.merging import mergeable, merged, save_merged
from emgs_jax.runs.results import is_finished, sound

FOLDER, WALK = "chunks", "walk.json"  # below the run's, with a folder for each chunk; there: which images they are of


def cut(count: int, chunks: int, overlap: int, every: int = 1) -> list[range]:
    """Cut frames into chunks of equal length, of which neighbours have `overlap` frames in common.

    Chunks begin at multiples of `every`, so that neighbours have the same keyframes in common.

    Raises:
        ValueError: the numbers are no such numbers, or a frame would be in three chunks.
    """
    if not (isinstance(chunks, int) and isinstance(overlap, int) and chunks > 1 and overlap > 0):
        raise ValueError(f"chunks must be 2 or more and overlap 1 or more, whole numbers, got {chunks} and {overlap}")
    if (count - overlap) // chunks < overlap + every - 1:
        most = (count - overlap) // (overlap + every - 1)
        raise ValueError(
            f"chunks={chunks} overlap={overlap} would leave each chunk of the {count} frames fewer new ones than it "
            "shares: " + (f"give chunks={most} or fewer" if most > 1 else "give a longer walk")
        )
    if overlap <= every:
        raise ValueError(f"overlap={overlap} has no keyframe of graph.every={every}: give overlap={2 * every} or more")
    begins = [number * (count - overlap) // chunks // every * every for number in range(chunks)]
    return [range(begin, end + overlap) for begin, end in zip(begins, [*begins[1:], count - overlap], strict=True)]


def run_chunks(
    config: DictConfig, folder: Path, job: Callable[[DictConfig], Any]
) -> tuple[dict[str, Any], Sequence[str]]:
    """Run the chunks of a walk that are not finished, each by a `job`, and join all into the run in `folder`.

    Returns:
        The metrics of the joined run, and which chunks are missing and why.
    """
    check(config)
    walk = walk_of(config)
    parts = cut(len(walk), config.chunks, config.overlap, config.graph.every)
    words = [words_of(config, part) for part in parts]
    names = [f"chunk {number} ({word[1]} {word[2]})" for number, word in enumerate(words, 1)]
    folders = [folder / FOLDER / str(number) for number in range(1, len(parts) + 1)]
    settings = [settings_of(config, word) for word in words]

    def undone() -> list[int]:
        remedy = "choose another hydra.run.dir= or move that folder away"
        return [row for row in range(len(parts)) if not is_finished(folders[row], settings[row], remedy)]

    with owned(folder):
        check_same(folder / FOLDER / WALK, fingerprint_of(config, walk))
        todo = undone()
        tqdm.write(f"{len(parts)} chunks of up to {max(map(len, parts))} frames, {len(todo)} of them to do")
        reasons = launch(folder / FOLDER, [[*words[row], f"hydra.sweep.subdir={row + 1}"] for row in todo], job)
        reasons, left = dict(zip(todo, reasons, strict=True)), undone()
        problems = [f"{names[row]} is missing: {reasons[row] or 'it was ended'}" for row in left]
        if len(parts) - len(left) < 2:
            raise ValueError("\n       ".join([*problems, "so there is nothing to join"]))
        tqdm.write(f"joining {len(parts) - len(left)} chunks …")
        try:
            read = [mergeable(folders[row]) for row in range(len(parts)) if row not in left]
            joined = merged(read, has_truth=True)
        except ValueError as error:
            raise ValueError("\n       ".join([*problems, str(error)])) from error
        for note in claim_folder(folder):
            tqdm.write(note)
        metrics, notes = save_merged(folder, read, joined, has_truth=True)
        run = read_run(folder)
        write_report(run, *images_of(run))
    for note in notes:
        tqdm.write(note)
    return metrics, problems


def fingerprint_of(config: DictConfig, walk: Dataset) -> str:
    """The fingerprint of a walk with its masks, without reading its images."""
    masks = build(config, "masks", _convert_="all")
    files, whole = files_of_masks(walk, masks, config.on_bad_frame == "skip"), walk.fingerprint()
    return fingerprint_with_masks(whole, files, masks.border) if any(files) else whole


def check_same(path: Path, fingerprint: str) -> None:
    """Note which images and masks the chunks are of; raise ValueError if finished ones are of others."""
    if path.exists():
        remedy = "if the images are those of its chunks, delete this file, else choose another hydra.run.dir="
        with sound(f"{path} is damaged, and said of which images the chunks beside it are", remedy):
            found = json.loads(path.read_text(encoding="utf-8"))["fingerprint"]
        if found != fingerprint:
            raise ValueError(
                f"{path.parent} has chunks of other images or masks: choose another hydra.run.dir= or move it away"
            )
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"fingerprint": fingerprint})


def check(config: DictConfig) -> None:
    """Raise ValueError for keys with which a walk cannot be cut."""
    if not config.graph:
        raise ValueError("chunks= joins runs by their keyframes: add graph=default")
    if "start" not in config.dataset or "record" in config.dataset:
        raise ValueError("chunks= needs a recorded walk, which a camera's is not: map its recording afterwards")
    for key, remedy in (("map", "emgs merge joins that run, too"), ("view", "emgs view"), ("polish", "emgs polish")):
        if config[key]:
            raise ValueError(f"{key}= is of one run, not of chunks=: leave it out ({remedy} afterwards)")
    if config.get("scale") and config.scale.distance:
        raise ValueError(
            "scale.distance= is of an image that one chunk has, and the others would have no unit: leave it out and "
            "give scale.height=, scale.positions= or scale.imu=, or do without chunks="
        )


def walk_of(config: DictConfig) -> Dataset:
    """Build the data set of the whole walk, without estimating intrinsics for it."""
    if config.dataset.get("intrinsics") != "estimate":
        return build(config, "dataset")

    def any_camera(pictures: Pictures) -> tuple[Calibration, dict[str, Any]]:
        width, height = pictures.size
        return from_numbers([width, width, width / 2, height / 2]), {}

    return build(config, "dataset", intrinsics=any_camera)


def words_of(config: DictConfig, part: range) -> list[str]:
    """Write the overrides by which a run maps some of the frames."""
    first, step = config.dataset.start, config.dataset.stride
    begin, stop = first + step * part[0], first + step * part[-1] + 1
    place = [f"prior.first={part[0]}"] if "first" in config.prior else []  # of a simulated one
    return ["chunks=null", f"dataset.start={begin}", f"dataset.stop={stop}", *place]


def settings_of(config: DictConfig, words: Sequence[str]) -> dict[str, Any]:
    """Resolve the settings of a chunk."""
    own = OmegaConf.merge(config, OmegaConf.from_dotlist([*words]))
    return OmegaConf.to_container(own, resolve=True)


def launch(folder: Path, chunks: Sequence[Sequence[str]], job: Callable[[DictConfig], Any]) -> list[str]:
    """Run jobs, each with its overrides beside those of this command, by Hydra's launcher; return why each failed."""
    if not chunks:
        return []
    master = copy.deepcopy(HydraConfig.instance().cfg)
    with read_write(master.hydra):
        master.hydra.sweep.dir = str(folder)
    context = HydraContext(config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(master))
    launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=job, config=master)
    # In the mode of several runs an error goes to Hydra and ends no other one.
    common = [*master.hydra.overrides.task, "hydra.mode=MULTIRUN", f"hydra.sweep.dir={written(str(folder))}"]
    try:
        return [why(done) for done in launcher.launch([[*common, *words] for words in chunks], initial_job_idx=0)]
    except Exception as error:  # of the launcher: a job was killed, or never started
        return [message_of(error)] * len(chunks)


def why(done: JobReturn) -> str:
    """Return the message of the error by which a job ended, if any."""
    try:
        done.return_value  # noqa: B018 (raises it)
    except Exception as error:  # whatever it was
        return message_of(error)
    return ""
