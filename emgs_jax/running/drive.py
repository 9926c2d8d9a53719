"""A sequence through the whole pipeline: what each input does to a run."""

from collections import deque
from collections.abc import Iterator, Mapping

import jax
from omegaconf import OmegaConf
from tqdm import tqdm

from emgs_jax.data.base import Dataset
from emgs_jax.observation import Prediction
from emgs_jax.prior.base import Prior
from emgs_jax.running.clock import Clock, Timer
from emgs_jax.running.compilation import use_compilation_cache
from emgs_jax.running.configure import RunConfig, build_dataset, build_prior
from emgs_jax.running.convert import FirstWindow
from emgs_jax.running.growth import advance, prepare, start
from emgs_jax.running.inputs import Input, RawView, inputs
from emgs_jax.running.record import (
    FrameRecord,
    MappingRun,
    correct,
    finish,
    new_run,
    record_lost,
    record_start,
    record_step,
)
from emgs_jax.running.unit import in_own_unit


def map_sequence(config: RunConfig, show_progress: bool = True) -> MappingRun:
    """Map the sequence of a config; the run holds the map, and a record with a pose for every frame.

    Args:
        config: of `load_config`.
        show_progress: draw a bar.

    Raises:
        ValueError: the data set, the prior or a frame cannot be used.
    """
    settings = OmegaConf.create(config.settings)
    use_compilation_cache(settings.compilation_cache)
    dataset = build_dataset(settings)
    prior = build_prior(settings, dataset)
    with (
        Clock().watching() as clock,
        tqdm(total=len(dataset), unit="frame", desc="mapping", disable=not show_progress) as bar,
    ):
        run = new_run(dataset, config.slam, clock, lambda record: show_record(bar, record), config.graph)
        deque(map_frames(run, dataset, prior), maxlen=0)
    return run


def show_record(bar: tqdm, record: FrameRecord) -> None:
    """Move the bar by one frame, and say what became of it."""
    bar.set_postfix_str(f"{record.status}, {record.num_gaussians or 0} Gaussians", refresh=False)
    bar.update()


def map_frames(run: MappingRun, dataset: Dataset, prior: Prior) -> Iterator[RawView]:
    """Map a sequence into `run`; yields on the way what the prior alone says of each frame, for comparison.

    Raises:
        ValueError: no frame has a point and a pose from which a map can start.
    """
    try:
        for given in inputs(dataset, prior, run.config, run.clock):
            with run.clock.phase("map"):
                take(run, given)
            yield from given.raw
        if run.back_end is not None:
            with run.clock.phase("back_end"):
                finish(run)
    finally:  # what an interrupted run leaves has the same unit
        in_own_unit(run)


def take(run: MappingRun, given: Input) -> None:
    """Integrate one input into the map of `run`, and record what became of its frames."""
    timer = Timer(run.clock)
    match given.taken:
        case None:
            record_lost(run, given)
            return
        case FirstWindow() as first:
            prepare(first, run.camera, run.config)
            run.state, run.config = start(first, run.camera, run.config)
            record_start(run, given, spent(given, timer))
            info = None
        case Prediction() as prediction:
            run.state, info, run.config = advance(run.state, prediction, run.camera, run.config)
            info = jax.device_get(info)
            record_step(run, given, info, spent(given, timer))
    if run.back_end is not None:
        with run.clock.phase("back_end"):
            correct(run, given, info)


def spent(given: Input, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Seconds of the conversion, and of what the timer saw as if the runs that shared it had been by themselves."""
    return {name: given.spent.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}
