"""Settings that are mapped and scored together on one sequence, for `sweep` and `tune`."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.device.clock import Clock
from emgs_jax.io.files import atomic_write
from emgs_jax.mapping.batch import finish_together, map_together, programs
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.mapping.window_input import RawView
from emgs_jax.prior.base import Prior
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.report.dense import center_cloud
from emgs_jax.report.gathering import gather
from emgs_jax.report.metrics import Metrics, Scorer, compared_text, score_settings
from emgs_jax.report.overview import thumbnail
from emgs_jax.report.provenance import provenance
from emgs_jax.report.sweeps import picture_path

from .grid import Variant

NOT_OF_RESULTS = (  # keys that change no number of a setting
    *("axes", "grid", "chunk", "at_once", "compilation_cache", "checksums"),
    *("space", "objectives", "tuned", "held_out", "trials", "startup", "search_seed", "best"),
)


@dataclass(frozen=True)
class Work:
    """Common inputs of all settings; `at_once`, `num_threads` as in `map_together`; `folder`: for pictures of maps."""

    dataset: ReadableFrames
    prior: Prior
    scorer: Scorer
    clock: Clock
    at_once: int
    num_threads: int
    folder: Path | None = None


def refuse_other_maps(config: DictConfig, what: str) -> None:
    """Raise ValueError where the config asks for what settings cannot share."""
    if config.baseline:
        raise ValueError(f"baseline= is for run and evaluate: {what} compares settings, and no baseline has them")
    if config.map:
        raise ValueError(f"map= is for run and evaluate: {what} makes its own maps")
    if config.graph:
        raise ValueError(f"graph= is for run and evaluate: {what} steps many maps at once, and no loop closes in them")
    if config.polish:
        raise ValueError(f"polish= is for run and evaluate: {what} draws maps as they are")
    if config.view:
        raise ValueError(f"view= is for run and evaluate: {what} maps many settings at once")


def shared_settings(config: DictConfig) -> dict[str, Any]:
    """The values that decide what a setting comes to, beside its own."""
    plain = OmegaConf.to_container(config, resolve=True)
    return {key: value for key, value in plain.items() if key not in NOT_OF_RESULTS}


def provenance_of(config: DictConfig, dataset: ReadableFrames, prior: Prior) -> dict[str, Any]:
    """The provenance that all settings share."""
    return provenance(shared_settings(config), dataset, prior.provenance)


def chunks_of(grid: Sequence[Variant], size: int) -> list[list[Variant]]:
    """Settings that share a program and a pass over the sequence, in chunks of equal size up to one."""
    if size < 1:
        raise ValueError(f"chunk must be at least 1 setting, got {size}")
    chunks = []
    for positions in programs([variant.slam for variant in grid]):
        count = -(-len(positions) // size)
        chunks += [[grid[position] for position in positions[start::count]] for start in range(count)]
    return chunks


def side_by_side(config: DictConfig, size: int) -> tuple[int, int]:
    """`at_once` and `num_threads`: vmap fills an accelerator, threads that share one executable fill a CPU.

    On a CPU vmap is slower than one setting after the other: the blocks of the neighbour search leave the cache, every
    setting waits for the solver of the slowest, and both sides of a condition are computed.
    """
    is_cpu = jax.default_backend() == "cpu"
    return config.at_once or (1 if is_cpu else size), os.cpu_count() if is_cpu else 1


def replayed(prior: Prior, dataset: ReadableFrames, window_size: int, folder: Path) -> Prior:
    """A prior that is asked more than once, as a recording in `folder`; what is recorded there already is kept."""
    if isinstance(prior, Recorded):
        return prior
    path = folder / f"window_{window_size}"
    record(prior, dataset, window_size, path, lambda calls: tqdm(calls, unit="inference", desc="predicting"))
    return Recorded(path)


def map_and_score(work: Work, chunk: Sequence[Variant], bar: tqdm) -> list[Metrics]:
    """Map and score some settings that share a program; the metrics of each."""
    groups = start = [new_run(work.dataset, variant.slam, work.clock) for variant in chunk]

    def frames() -> Iterator[tuple[None, RawView]]:
        nonlocal groups
        for found in map_together(start, work.dataset, work.prior, work.at_once, work.num_threads):
            groups, views = found
            bar.update(len(views) * len(chunk))
            yield from ((None, view) for view in views)

    text = compared_text(work.dataset, work.scorer.prior)
    raw = gather(frames(), work.scorer.evaluation, work.dataset.has_ground_truth, text=text)
    runs = finish_together(groups)
    densify = [variant.densify for variant in chunk]
    metrics = score_settings(runs, raw, densify, work.scorer, work.num_threads)
    if work.folder is not None:
        for variant, run in zip(chunk, runs, strict=True):
            _draw(picture_path(work.folder, variant.setting), run)
    return metrics


def _draw(path: Path, run: MappingRun) -> None:
    """Write the map from above."""
    centers = center_cloud(run)
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as handle:
        thumbnail(centers.points, centers.colors, np.stack(run.poses)).save(handle, "JPEG", quality=85)
