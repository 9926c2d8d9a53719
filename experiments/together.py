"""Settings that are mapped and scored together on one sequence, for `sweep` and `tune`."""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.config.configure import build, build_dataset, build_prior
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.device.clock import Clock
from emgs_jax.io.files import atomic_write, remove_temporaries
from emgs_jax.mapping.batch import finish_together, map_together, programs
from emgs_jax.mapping.run import new_run
from emgs_jax.mapping.window_input import RawView
from emgs_jax.prior.base import Prior
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.report.dense import center_cloud
from emgs_jax.report.gathering import gather
from emgs_jax.report.metrics import Metrics, Scorer, compared_text, new_scorer, score_settings
from emgs_jax.report.overview import thumbnail
from emgs_jax.report.provenance import provenance
from emgs_jax.report.sweeps import SweepResults, picture_path

from .grid import Variant, plain_setting

NOT_OF_RESULTS = (  # keys that change no number of a setting
    *("axes", "grid", "chunk", "at_once", "compilation_cache"),
    *("space", "objectives", "tuned", "held_out", "trials", "startup", "search_seed", "best"),
)


def refuse_other_maps(config: DictConfig, what: str) -> None:
    """Raise ValueError where the config asks for what settings cannot share."""
    for key, reason in {
        "baseline": "compares settings, and no baseline has them",
        "map": "makes its own maps",
        "graph": "steps many maps at once, and no loop closes in them",
        "polish": "draws maps as they are",
        "view": "maps many settings at once",
    }.items():
        if config[key]:
            raise ValueError(f"{key}= is for run and evaluate: {what} {reason}")


@contextlib.contextmanager
def resumed() -> Iterator[Path]:
    """The folder of a command, of which Ctrl-C says how it is gone on with."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        yield folder
    except KeyboardInterrupt:
        print(f"what is done is in {folder}; the same command with hydra.run.dir={folder} goes on from there")
        raise


def shared_settings(config: DictConfig) -> dict[str, Any]:
    """The values that decide what a setting comes to, beside its own."""
    plain = OmegaConf.to_container(config, resolve=True)
    return {key: value for key, value in plain.items() if key not in NOT_OF_RESULTS}


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


class Measured:
    """A sequence, and what settings came to on it: kept on disk after every chunk, measured once.

    Frames, predictions and the truth are made once for all settings. A prior that is asked again is replayed from a
    recording, until `forget_predictions`.

    Args:
        name: for the progress bar.
        clock: of all sequences.
        has_pictures: draw every map from above.
        is_asked_again: settings are measured in several calls.
    """

    def __init__(
        self,
        config: DictConfig,
        folder: Path,
        clock: Clock,
        name: str = "mapping",
        has_pictures: bool = False,
        is_asked_again: bool = False,
    ) -> None:
        self.config, self.name, self.folder, self.clock = config, name, folder, clock
        self.has_pictures, self._is_asked_again = has_pictures, is_asked_again
        folder.mkdir(parents=True, exist_ok=True)
        remove_temporaries(folder)  # of writes that were killed
        self.dataset = build_dataset(config)
        self.prior = build_prior(config, self.dataset)
        self.provenance = provenance(shared_settings(config), self.dataset, self.prior.provenance)
        self._results = SweepResults(folder, self.provenance)
        self._priors: dict[int, Prior] = {}

    def __contains__(self, setting: Mapping[str, Any]) -> bool:
        return plain_setting(setting) in self._results

    @cached_property
    def scorer(self) -> Scorer:
        return new_scorer(self.dataset, build(self.config, "evaluation"), self.prior)

    def measure(self, grid: Sequence[Variant]) -> int:
        """Map and score those that are not there yet, in chunks of the whole grid, which a resumed one has to keep.

        Returns:
            How many that are.
        """
        chunks = [[one for one in chunk if one.setting not in self] for chunk in chunks_of(grid, self.config.chunk)]
        chunks = [chunk for chunk in chunks if chunk]
        sizes, num_left = [chunk[0].slam.window_size for chunk in chunks], sum(map(len, chunks))
        for size in {*sizes} - {*self._priors}:
            self.prior.check(self.dataset, size)
            is_asked_again = self._is_asked_again or sizes.count(size) > 1
            folder = self.folder / "predictions"
            self._priors[size] = replayed(self.prior, self.dataset, size, folder) if is_asked_again else self.prior
        total = len(self.dataset) * num_left
        with tqdm(total=total, unit="frame", desc=self.name, disable=not chunks) as bar:
            for chunk in chunks:
                prior = self._priors[chunk[0].slam.window_size]
                self._results.add([one.setting for one in chunk], map_and_score(self, prior, chunk, bar))
        return num_left

    def rows(self, settings: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return a flat row for each setting that was measured: its number, its values and its metrics."""
        return self._results.rows([plain_setting(setting) for setting in settings])

    def forget_predictions(self) -> None:
        """Remove what was recorded."""
        shutil.rmtree(self.folder / "predictions", ignore_errors=True)


def replayed(prior: Prior, dataset: ReadableFrames, window_size: int, folder: Path) -> Prior:
    """A prior that is asked more than once, as a recording in `folder`; what is recorded there already is kept."""
    if isinstance(prior, Recorded):
        return prior
    path = folder / f"window_{window_size}"
    record(prior, dataset, window_size, path, lambda calls: tqdm(calls, unit="inference", desc="predicting"))
    return Recorded(path)


def map_and_score(sequence: Measured, prior: Prior, chunk: Sequence[Variant], bar: tqdm) -> list[Metrics]:
    """Map and score some settings that share a program by the answers of a prior; the metrics of each."""
    dataset, scorer = sequence.dataset, sequence.scorer
    groups = start = [new_run(dataset, variant.slam, sequence.clock) for variant in chunk]
    at_once, num_threads = side_by_side(sequence.config, len(chunk))

    def frames() -> Iterator[tuple[None, RawView]]:
        nonlocal groups
        for found in map_together(start, dataset, prior, at_once, num_threads):
            groups, views = found
            bar.update(len(views) * len(chunk))
            yield from ((None, view) for view in views)

    text = compared_text(dataset, scorer.prior)
    raw = gather(frames(), scorer.evaluation, dataset.has_ground_truth, text=text)
    runs = finish_together(groups)
    densify = [variant.densify for variant in chunk]
    metrics = score_settings(runs, raw, densify, scorer, num_threads)
    for variant, run in zip(chunk, runs, strict=True) if sequence.has_pictures else ():
        centers, path = center_cloud(run), picture_path(sequence.folder, variant.setting)
        path.parent.mkdir(exist_ok=True)
        with atomic_write(path) as handle:
            thumbnail(centers.points, centers.colors, np.stack(run.poses)).save(handle, "JPEG", quality=85)
    return metrics
