"""A grid of settings on one sequence: `python -m experiments.sweep sweep=gates dataset=… prior=…`.

The axes are keys of a stage, from conf/sweep/ or the command line: `'axes={slam.em.noise:[0,1]}'`. Frames, predictions
and the truth are made once for the whole grid. An interrupted sweep goes on with the same command and `hydra.run.dir=`
its folder.
"""

import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from emgs_jax.config.configure import build, build_dataset, build_prior
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.device.clock import Clock
from emgs_jax.io.files import owned, remove_temporaries
from emgs_jax.prior.base import Prior
from emgs_jax.report.heat_map import draw
from emgs_jax.report.metrics import new_scorer
from emgs_jax.report.sweep_page import write_sweep_page
from emgs_jax.report.sweeps import SweepResults, table, write_csv

from .command import command
from .grid import Variant, notes, read_axes, variants
from .together import Work, chunks_of, map_and_score, provenance_of, refuse_other_maps, replayed, side_by_side


def sweep(config: DictConfig, folder: Path, command_line: str = "") -> list[dict[str, Any]]:
    """Map and score every setting of `config.axes` that `folder` has not; returns a flat row for each.

    The page says that `command_line` repeats it.
    """
    refuse_other_maps(config, "a sweep")
    axes = read_axes(config)
    grid = variants(config, axes)
    for note in notes(config, axes):
        print(note)
    with owned(folder), Clock().watching() as clock:
        remove_temporaries(folder)  # of writes that were killed
        dataset = build_dataset(config)
        prior = build_prior(config, dataset)
        origin = provenance_of(config, dataset, prior)
        results = SweepResults(folder, origin)
        chunks = _left(chunks_of(grid, config.chunk), results)
        num_left = sum(map(len, chunks))
        if num_left < len(grid):
            print(f"going on: {num_left} of {len(grid)} settings are left")
        scorer = new_scorer(dataset, build(config, "evaluation"), prior) if chunks else None
        with _replayed(prior, dataset, chunks, folder / "predictions") as priors, _bar(dataset, chunks) as bar:
            for chunk in chunks:
                window_size = chunk[0].slam.window_size
                work = Work(dataset, priors[window_size], scorer, clock, *side_by_side(config, len(chunk)), folder)
                results.add([variant.setting for variant in chunk], map_and_score(work, chunk, bar))
    rows = results.rows([variant.setting for variant in grid])
    write_csv(folder / "sweep.csv", rows)
    if config.grid == "product":  # else most cells of a picture would be empty
        title = f"{dataset.name} {dataset.sequence}, {prior.provenance.name}"
        no_picture = draw(folder / "heat_map.png", rows, axes, title)
        if no_picture:
            print(f"no heat_map.png: {no_picture}")
    write_sweep_page(folder, origin, rows, list(axes), command_line)
    print(table(rows, list(axes)))
    print(f"{num_left} settings in {clock.total_seconds:.1f} s, {clock.compile_seconds:.1f} s of it compilation")
    return rows


def _left(chunks: Sequence[Sequence[Variant]], results: SweepResults) -> list[list[Variant]]:
    """Return the settings that are not done, by chunks of the whole grid, which a resumed sweep has to keep."""
    left = ([variant for variant in chunk if variant.setting not in results] for chunk in chunks)
    return [chunk for chunk in left if chunk]


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
        if sizes.count(size) > 1:
            priors[size] = replayed(prior, dataset, size, folder)
    yield priors
    shutil.rmtree(folder, ignore_errors=True)


def _bar(dataset: ReadableFrames, chunks: Sequence[Sequence[Variant]]) -> tqdm:
    return tqdm(total=len(dataset) * sum(map(len, chunks)), unit="frame", desc="mapping", disable=not chunks)


@command("sweep")
def main(config: DictConfig) -> None:
    """Sweep, and say where the results are."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        sweep(config, folder, shlex.join(["emgs", "sweep", *HydraConfig.get().overrides.task]))
    except KeyboardInterrupt:
        print(f"what is done is in {folder}; the same command with hydra.run.dir={folder} goes on from there")
        raise
    print(f"everything is in {folder}, report.html shows it")


if __name__ == "__main__":
    main()
