"""A grid of settings on one sequence: `python -m experiments.sweep sweep=gates dataset=… prior=…`.

The axes are keys of a stage, from conf/sweep/ or the command line: `'axes={slam.em.noise:[0,1]}'`. Frames, predictions
and the truth are made once for the whole grid. An interrupted sweep goes on with the same command and `hydra.run.dir=`
its folder.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.io.files import remove_temporaries
from emgs_jax.prior.base import Prior
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.report.metrics import Metrics, Scorer, compared_text, new_scorer, score_settings
from emgs_jax.report.provenance import provenance
from emgs_jax.report.sweeps import SweepResults, draw, table, write_csv
from emgs_jax.running.clock import Clock
from emgs_jax.running.configure import build, build_dataset, build_prior
from emgs_jax.running.gathering import gather
from emgs_jax.running.record import new_run
from emgs_jax.running.stacked import map_together, programs

from .command import command
from .grid import Variant, notes, read_axes, variants

NOT_OF_RESULTS = ("axes", "grid", "chunk", "at_once", "compilation_cache", "checksums")  # keys that change no number


@dataclass(frozen=True)
class Work:
    """What all settings share; `at_once` and `num_threads` as in `map_together`."""

    dataset: ReadableFrames
    prior: Prior
    scorer: Scorer
    clock: Clock
    at_once: int
    num_threads: int


def sweep(config: DictConfig, folder: Path) -> list[dict[str, Any]]:
    """Map and score every setting of `config.axes` that `folder` has not; returns a flat row for each."""
    if config.baseline:
        raise ValueError("baseline= is for run and evaluate: a sweep compares settings, and no baseline has them")
    if config.map:
        raise ValueError("map= is for run and evaluate: a sweep makes its own maps")
    if config.graph:
        raise ValueError("graph= is for run and evaluate: a sweep steps many maps at once, and no loop closes in them")
    if config.view:
        raise ValueError("view= is for run and evaluate: a sweep maps many settings at once")
    axes = read_axes(config)
    grid = variants(config, axes)
    for note in notes(config, axes):
        print(note)
    folder.mkdir(parents=True, exist_ok=True)
    remove_temporaries(folder)  # of writes that were killed
    with Clock().watching() as clock:
        dataset = build_dataset(config)
        prior = build_prior(config, dataset)
        results = SweepResults(folder, _provenance(config, dataset, prior))
        chunks = _left(_chunks(grid, config.chunk), results)
        num_left = sum(map(len, chunks))
        if num_left < len(grid):
            print(f"going on: {num_left} of {len(grid)} settings are left")
        scorer = new_scorer(dataset, build(config, "evaluation"), prior) if chunks else None
        with _replayed(prior, dataset, chunks, folder / "predictions") as priors, _bar(dataset, chunks) as bar:
            for chunk in chunks:
                window_size = chunk[0].slam.window_size
                work = Work(dataset, priors[window_size], scorer, clock, *_side_by_side(config, len(chunk)))
                results.add([variant.setting for variant in chunk], _map_and_score(work, chunk, bar))
    rows = results.rows([variant.setting for variant in grid])
    write_csv(folder / "sweep.csv", rows)
    if config.grid == "product":  # else most cells of a picture would be empty
        title = f"{dataset.name} {dataset.sequence}, {prior.provenance.name}"
        no_picture = draw(folder / "heat_map.png", rows, axes, title)
        if no_picture:
            print(f"no heat_map.png: {no_picture}")
    print(table(rows, list(axes)))
    print(f"{num_left} settings in {clock.total_seconds:.1f} s, {clock.compile_seconds:.1f} s of it compilation")
    return rows


def _provenance(config: DictConfig, dataset: ReadableFrames, prior: Prior) -> dict[str, Any]:
    plain = OmegaConf.to_container(config, resolve=True)
    shared = {key: value for key, value in plain.items() if key not in NOT_OF_RESULTS}
    return provenance(shared, dataset, prior.provenance)


def _chunks(grid: Sequence[Variant], size: int) -> list[list[Variant]]:
    """Settings that share a program and a pass over the sequence, in chunks of equal size up to one."""
    if size < 1:
        raise ValueError(f"chunk must be at least 1 setting, got {size}")
    chunks = []
    for positions in programs([variant.slam for variant in grid]):
        count = -(-len(positions) // size)
        chunks += [[grid[position] for position in positions[start::count]] for start in range(count)]
    return chunks


def _left(chunks: Sequence[Sequence[Variant]], results: SweepResults) -> list[list[Variant]]:
    """What is not done of chunks of the whole grid: a sweep that goes on has the chunks of one that nobody stopped."""
    left = ([variant for variant in chunk if variant.setting not in results] for chunk in chunks)
    return [chunk for chunk in left if chunk]


def _side_by_side(config: DictConfig, size: int) -> tuple[int, int]:
    """`at_once` and `num_threads`: vmap fills an accelerator, threads that share one executable fill a CPU.

    On a CPU vmap is slower than one setting after the other: the blocks of the neighbour search leave the cache, every
    setting waits for the solver of the slowest, and both sides of a condition are computed.
    """
    is_cpu = jax.default_backend() == "cpu"
    return config.at_once or (1 if is_cpu else size), os.cpu_count() if is_cpu else 1


@contextmanager
def _replayed(
    prior: Prior, dataset: ReadableFrames, chunks: Sequence[Sequence[Variant]], folder: Path
) -> Iterator[dict[int, Prior]]:
    """The prior of every window size; where it is asked more than once, a recording, which is removed at the end."""
    sizes = [chunk[0].slam.window_size for chunk in chunks]
    priors = {}
    for size in dict.fromkeys(sizes):
        prior.check(dataset, size)
        priors[size] = prior
        if sizes.count(size) > 1 and not isinstance(prior, Recorded):
            path = folder / f"window_{size}"
            record(prior, dataset, size, path, lambda calls: tqdm(calls, unit="inference", desc="predicting"))
            priors[size] = Recorded(path)
    yield priors
    shutil.rmtree(folder, ignore_errors=True)


def _bar(dataset: ReadableFrames, chunks: Sequence[Sequence[Variant]]) -> tqdm:
    return tqdm(total=len(dataset) * sum(map(len, chunks)), unit="frame", desc="mapping", disable=not chunks)


def _map_and_score(work: Work, chunk: Sequence[Variant], bar: tqdm) -> list[Metrics]:
    runs = [new_run(work.dataset, variant.slam, work.clock, lambda record: bar.update()) for variant in chunk]
    views = map_together(runs, work.dataset, work.prior, work.at_once, work.num_threads)
    text = compared_text(work.dataset, work.scorer.prior)
    raw = gather(views, work.scorer.evaluation, work.dataset.has_ground_truth, text=text)
    densify = [variant.densify for variant in chunk]
    return score_settings(runs, raw, densify, work.scorer, work.num_threads)


@command("sweep")
def main(config: DictConfig) -> None:
    """Sweep, and say where the results are."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        sweep(config, folder)
    except KeyboardInterrupt:
        print(f"what is done is in {folder}; the same command with hydra.run.dir={folder} goes on from there")
        raise
    print(f"everything is in {folder}")


if __name__ == "__main__":
    main()
