"""A run that goes on, saved as a finished run of its frames so far: what is saved stays, whatever ends the program."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.io.files import FrameLog, new_folder
from emgs_jax.mapping.pipeline import finish_run
from emgs_jax.mapping.records import to_line
from emgs_jax.mapping.run import MappingRun
from emgs_jax.prior.base import Prior
from emgs_jax.runs.files import save_classes, save_progress
from emgs_jax.runs.finished_run import FRAMES_FILE
from emgs_jax.runs.metrics import describe
from emgs_jax.runs.provenance import write_metrics
from emgs_jax.runs.results import METRICS_FILE


def save_snapshot(
    folder: Path,
    run: MappingRun,
    sources: tuple[ReadableFrames, Prior],
    origin: Mapping[str, Any],
    recorded: str | None = None,
) -> Path:
    """Write a run so far into `folder`/saved-1, -2, …, which appears when it is whole; return that folder.

    Args:
        sources: the data set and the prior of the run.
        origin: of the run, as `provenance` gives it.
        recorded: name of the folder of a recording, which moves into the snapshot, as no more frames come to it.

    Raises:
        ValueError: nothing is mapped yet.
    """
    if run.state is None:
        raise ValueError("nothing is mapped yet")
    dataset, prior = sources
    number = next(number for number in itertools.count(1) if not (folder / f"saved-{number}").exists())
    target, done = folder / f"saved-{number}", finish_run(run, is_interrupted=True)
    frames = dataset.recording()
    if frames is not None:
        frames = {**frames, "stop": len(run.records)}
    if frames is not None and recorded is not None:
        frames["root"] = str((target / recorded).resolve())
    config = origin["config"] | ({} if frames is None else {"dataset": frames})
    with new_folder(target) as new:
        with FrameLog(new / FRAMES_FILE) as log:
            for record in done.records:
                log.append(to_line(record) | {"index": dataset.kept[record.index]})
        save_progress(new, done)
        save_classes(new, prior)
        write_metrics(new / METRICS_FILE, describe(done) | {"provenance": {**origin, "config": config}})
    if frames is not None and recorded is not None:
        (folder / recorded).rename(target / recorded)
    return target
