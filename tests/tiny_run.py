"""One small setting for every test that needs a whole run; all have the same shapes, so a process compiles once."""

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import hydra
from filelock import FileLock

from emgs_jax.config import configure
from emgs_jax.config.configure import CONF  # noqa: F401 (for the tests of scripts)
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.prior.base import Prior, PriorPrediction

NUM_FRAMES, WINDOW_SIZE = 6, 3
TINY = (
    *("dataset.size=[64,48]", "dataset.num_frames=40", f"dataset.stop={NUM_FRAMES}"),
    *("slam.observation.thin=1", "slam.observation.normal_radius=1", "slam.observation.normal_spacing=1"),
    *("slam.fit.points_per_gaussian=529", "slam.fit.num_fit_neighbours=8", "slam.fit.num_kmeans_iterations=2"),
    *("slam.submap.map_capacity=1024", "slam.submap.submap_capacity=1024", "slam.em.num_neighbours=6"),
    *("render.tile_size=16", "render.tile_capacity=192", "slam.localization.icp.num_points=512"),
    f"slam.window_size={WINDOW_SIZE}",
)
SMOKE = (  # for what needs images in which places are recognised; as few points and rows as that takes
    *("experiment=smoke", "slam.observation.thin=4", "slam.localization.icp.num_points=512"),
    *("slam.submap.map_capacity=2048", "slam.submap.submap_capacity=1024"),
    *("slam.em.num_neighbours=6", "slam.fit.num_fit_neighbours=8"),
)


def compose(*overrides: str, name: str = "config"):
    """conf/ as Hydra composes it for a script, with the small setting; a copy of one's own."""
    return copy.deepcopy(_composed(*overrides, name=name))


@cache
def _composed(*overrides: str, name: str):
    return configure.compose(*TINY, *overrides, name=name)


@cache
def dataset() -> ReadableFrames:
    return ReadableFrames(hydra.utils.instantiate(compose().dataset))


class EditedPrior(Prior):
    """The exact prior, with each prediction passed through `edit`, which may raise."""

    def __init__(self, edit: Callable[[PriorPrediction], PriorPrediction] = lambda prediction: prediction) -> None:
        self._prior = hydra.utils.instantiate(compose("prior.level=0").prior, classes=list(dataset().classes))
        self._edit, self.provenance = edit, self._prior.provenance
        self.feature_names, self.text_features = self._prior.feature_names, self._prior.text_features

    def predict(self, window, frames, intrinsics) -> PriorPrediction:
        return self._edit(self._prior.predict(window, frames, intrinsics))


def at_inference(number: int, **arrays) -> Callable[[PriorPrediction], PriorPrediction]:
    """An edit: at one inference, arrays are filled with these values."""

    def edit(prediction: PriorPrediction) -> PriorPrediction:
        if prediction.window.inference != number:
            return prediction
        filled = {name: getattr(prediction, name).copy() for name in arrays}
        for name, value in arrays.items():
            filled[name][...] = value
        return dataclasses.replace(prediction, **filled)

    return edit


def map_tiny(frames, prior, *overrides: str) -> tuple[MappingRun, list]:
    """A finished run, and the map after each record."""
    maps = []
    run = start = new_run(frames, hydra.utils.instantiate(compose(*overrides).slam))
    for run, new, _ in map_frames(start, frames, prior):
        maps += [run.map] * len(new)
    return finish_run(run), maps


@cache
def exact() -> tuple[MappingRun, list]:
    """The finished run with the exact prior, and the map after each record; nobody changes it."""
    return map_tiny(dataset(), EditedPrior())


def make_exact_run(shared: Path, finished: Path | None = None) -> tuple[Path, dict]:
    """Folder and metrics of `experiments.run` with the exact prior; who comes first makes it, others wait.

    Args:
        shared: by all processes.
        finished: a folder with such a run, to take instead of another one.
    """
    import experiments.run

    folder, done = shared / "exact_run", shared / "exact_run.done"
    with FileLock(shared / "exact_run.lock"):
        if not done.exists() and finished is not None:
            shutil.copytree(finished, folder, dirs_exist_ok=True)
        elif not done.exists():
            folder.mkdir(exist_ok=True)
            experiments.run.run(compose("prior.level=0"), folder)
        done.touch()
    return folder, json.loads((folder / "metrics.json").read_text())
