"""A sequence through the pipeline for many settings: what is the same for all of them is done once."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import numpy as np

from emgs_jax import outputs, scoring
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.convert import to_first_window, to_prediction
from emgs_jax.evaluation.clouds import PointCloud
from emgs_jax.evaluation.reconstruction import EvaluationConfig
from emgs_jax.observation import Prediction
from emgs_jax.pipeline import (
    MappingRun,
    RawView,
    Timer,
    first_pose,
    predictions,
    raw_views,
    record_initialization,
    record_step,
)
from emgs_jax.prior.base import Prior, PriorPrediction
from emgs_jax.pytree import Tree, stack
from emgs_jax.render.densify import DensifyConfig
from emgs_jax.slam import FirstWindow, SlamConfig, SlamState, advance, opening, start
from emgs_jax.sweep import jitted_init_states, jitted_step_states


@dataclass
class _Stack:
    """Runs that one call of the step advances, and their states and configs, stacked where there are several."""

    runs: Sequence[MappingRun]
    configs: SlamConfig
    states: SlamState | None = None

    @property
    def is_stacked(self) -> bool:
        return len(self.runs) > 1

    def start(self, window: FirstWindow, frames: list[Frame]) -> None:
        """Make the maps and record the frames that they are made from."""
        timer, camera = Timer(self.runs[0].clock), self.runs[0].camera
        init = (jitted_init_states,) if self.is_stacked else ()
        self.states, self.configs = start(window, camera, self.configs, *init)
        self.unstack()
        spent = self._share(timer)
        for run in self.runs:
            record_initialization(run, window, frames, spent)

    def advance(self, prediction: Prediction, frame: Frame) -> None:
        """Take one step and record it."""
        timer, camera = Timer(self.runs[0].clock), self.runs[0].camera
        step = (jitted_step_states,) if self.is_stacked else ()
        self.states, infos, self.configs = advance(self.states, prediction, camera, self.configs, *step)
        infos = jax.device_get(infos)
        spent = self._share(timer)
        for position, run in enumerate(self.runs):
            record_step(run, frame, self._item(infos, position), spent)

    def unstack(self) -> None:
        """Give every run its own state and config."""
        for position, run in enumerate(self.runs):
            run.state, run.config = self._item((self.states, self.configs), position)

    def _item(self, tree: Tree, position: int) -> Tree:
        return jax.tree.map(lambda leaf: leaf[position], tree) if self.is_stacked else tree

    def _share(self, timer: Timer) -> dict[str, float]:
        return {name: seconds / len(self.runs) for name, seconds in timer.read().items()}


def map_settings(
    runs: Sequence[MappingRun], dataset: Dataset, prior: Prior, at_once: int, num_threads: int
) -> Iterator[RawView]:
    """`map_frames` for runs that share a program (`sweep.programs`) and a clock.

    Frames are read, predicted and converted once for all runs. Every run ends with the state, records and poses that
    `map_frames` gives it.

    Args:
        runs: before their first frame.
        dataset: of all of them.
        prior: likewise.
        at_once: runs that vmap steps together, which keeps an accelerator busy. With 1 every run takes the very
            executable of `slam.step`, so its result is that of `map_frames` bit for bit.
        num_threads: such groups that are stepped side by side, which keeps the cores of a CPU busy.
    """
    groups = [runs[row : row + at_once] for row in range(0, len(runs), at_once)]
    stacks = [
        _Stack(group, stack([run.config for run in group]) if len(group) > 1 else group[0].config) for group in groups
    ]
    first, anchor = runs[0], None
    with ThreadPoolExecutor(num_threads) as threads:
        for prediction, frames in predictions(dataset, prior, first.config.window_size, first.clock):
            anchor = first_pose(frames) if anchor is None else anchor
            with first.clock.phase("map"):
                for task in _tasks(first, prediction, frames, anchor):
                    task(stacks[0])  # by itself: what it compiles is there for the others
                    list(threads.map(task, stacks[1:]))
            yield from raw_views(first, prediction, frames, anchor)
    for one in stacks:
        one.unstack()
    for run in runs[1:]:
        run.raw_poses = first.raw_poses


def _tasks(
    run: MappingRun, prediction: PriorPrediction, frames: Mapping[int, Frame], anchor: np.ndarray
) -> Iterator[Callable[[_Stack], None]]:
    """What every stack has to do with one prediction, which is converted here."""
    if prediction.window.inference > 0:
        step = to_prediction(prediction, frames, anchor, run.config.observation)
        yield lambda one: one.advance(step, frames[prediction.window.current])
        return
    window, following = opening(to_first_window(prediction, frames, anchor, run.config.observation), run.config)
    dense = [frames[index] for index in prediction.window.dense]
    yield lambda one: one.start(window, dense)
    for frame, step in zip(dense[1:], following, strict=False):
        yield lambda one, step=step, frame=frame: one.advance(step, frame)


@dataclass(frozen=True)
class Scorer:
    """What the maps of one data set are compared with, made once.

    Args:
        dataset: in use.
        evaluation: the protocol.
        truth: its true cloud; None without ground truth.
        num_skipped: frames that cannot be read.
    """

    dataset: Dataset
    evaluation: EvaluationConfig
    truth: PointCloud | None
    num_skipped: int


def score_settings(
    runs: Sequence[MappingRun],
    raw_cloud: PointCloud,
    densify: Sequence[DensifyConfig],
    scorer: Scorer,
    num_threads: int,
) -> list[scoring.Metrics]:
    """The metrics.json of every finished run, without times.

    Args:
        runs: of `map_settings`.
        raw_cloud: the prior's points, the same for all.
        densify: of each run.
        scorer: the truth.
        num_threads: runs that are scored side by side.
    """
    evaluation, truth = scorer.evaluation, scorer.truth
    shared = {} if truth is None else scoring.score_prior(runs[0], raw_cloud, truth, evaluation)

    def score(run: MappingRun, config: DensifyConfig) -> scoring.Metrics:
        counts = {k: v for k, v in scoring.describe(run, scorer.num_skipped).items() if not k.startswith("time/")}
        if truth is None:
            return counts
        dense = outputs.dense_map(run, scorer.dataset, config, evaluation.voxel_m, num_pictures=0).cloud
        centers = outputs.center_cloud(run)
        return scoring.score_map(run, dense, centers, truth, evaluation) | shared | counts

    first = score(runs[0], densify[0])
    with ThreadPoolExecutor(num_threads) as threads:
        return [first, *threads.map(score, runs[1:], densify[1:])]
