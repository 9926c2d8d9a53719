"""A long run in this process, with what it costs at each step; and what must be true of a map whatever was seen."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np

from emgs_jax.config.configure import build
from emgs_jax.data.base import Dataset
from emgs_jax.device.clock import Clock
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.report.metrics import STATUSES
from tests.tiny_run import compose

PAGE_BYTES = 4096


@dataclass
class Curves:
    """Measurements at each frame: MiB of this process, seconds of the step, Gaussians, and the status."""

    memory_mb: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    num_gaussians: list[int] = field(default_factory=list)
    status: list[str] = field(default_factory=list)

    def add(self, record: FrameRecord) -> None:
        self.memory_mb.append(memory_mb())
        self.seconds.append(record.seconds - record.compile_seconds)
        self.num_gaussians.append(record.num_gaussians or 0)
        self.status.append(record.status)


def memory_mb() -> float:
    """MiB that this process holds now (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_BYTES / 2**20


def soak(dataset: Dataset, overrides: Sequence[str] = (), seconds: float = np.inf) -> tuple[MappingRun, Curves]:
    """Map a sequence with the small setting of the tests and the simulated prior, for so many seconds at most."""
    curves, end = Curves(), time.monotonic() + seconds
    with Clock().watching() as clock:
        run = start = new_run(dataset, build(compose(*overrides), "slam"), clock)
        for found in map_frames(start, dataset, Simulated(seed=0, classes=dataset.classes)):
            run, new, _ = found
            for record in new:
                curves.add(record)
            if time.monotonic() > end:
                break
    return finish_run(run), curves


def faults(run: MappingRun, num_frames: int) -> list[str]:
    """List what is wrong with a run over so many frames; empty if nothing is."""
    gaussians = jax.device_get(run.map.gaussians)
    valid = gaussians.valid
    found = [
        f"{jax.tree_util.keystr(path)} has values that are not finite"
        for path, leaf in jax.tree_util.tree_leaves_with_path(gaussians)
        if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(leaf[valid]).all()
    ]
    eigenvalues = np.linalg.eigvalsh(gaussians.covs[valid])
    if valid.any() and eigenvalues.min() <= 0:
        found.append(f"a covariance has the eigenvalue {eigenvalues.min():g}")
    if not valid.any():
        found.append("the map is empty")
    if [record.index for record in run.records] != list(range(num_frames)):
        found.append(f"{len(run.records)} records of {num_frames} frames")
    found += [f"frame {r.index} has the status {r.status}" for r in run.records if r.status not in STATUSES]
    found += [f"frame {r.index} has no reason" for r in run.records if r.status in STATUSES[1:3] and not r.reason]
    if not np.isfinite(run.poses).all():
        found.append("a pose is not finite")
    return found


def ratio(values: Sequence[float]) -> float:
    """Median of the last tenth over that of the second tenth, before which programs are compiled and rooms grow."""
    tenth = len(values) // 10
    return float(np.median(values[-tenth:]) / np.median(values[tenth : 2 * tenth]))


def grown(ratios: Mapping[str, float], most: float) -> list[str]:
    """List the names, each with its `ratio`, of what has grown by more than `most`."""
    return [f"{name} grew to {value:.3f} times, {most:g} is allowed" for name, value in ratios.items() if value > most]
