"""Sequences through the whole pipeline, frame by frame: what the prior says, what the maps take, what is recorded."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.observation import Prediction
from emgs_jax.ops.pytree import Tree, stack
from emgs_jax.prior.base import Prior, PriorPrediction, windows
from emgs_jax.running.clock import Clock
from emgs_jax.running.convert import to_first_window, to_prediction
from emgs_jax.running.record import MappingRun, Timer, record_before_map, record_initialization, record_step
from emgs_jax.running.stacked import jitted_init_states, jitted_step_states
from emgs_jax.slam import (
    FirstWindow,
    SlamConfig,
    SlamState,
    advance,
    jitted_init_state,
    jitted_step,
    opening,
    start,
)

RawView = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # points, mask, image, T_world_camera
Seconds = Mapping[str, float]  # as a `Timer` reads


def predictions(
    dataset: Dataset, prior: Prior, window_size: int, clock: Clock
) -> Iterator[tuple[PriorPrediction, dict[int, Frame]]]:
    """Ask the prior window by window; frames are read when a window needs them and dropped when none does."""
    frames: dict[int, Frame] = {}
    for window in windows(len(dataset), window_size):
        with clock.phase("load"):
            frames = {index: frames[index] if index in frames else dataset[index] for index in window.views}
        with clock.phase("predict"):
            prediction = prior.predict(window, list(frames.values()), dataset.intrinsics)
        yield prediction, frames


@dataclass
class _Group:
    """Runs that one call of the step advances; where there are several, their states and configs are stacked."""

    runs: Sequence[MappingRun]
    configs: SlamConfig
    states: SlamState | None = None

    @property
    def is_stacked(self) -> bool:
        return len(self.runs) > 1

    def start(self, window: FirstWindow, frames: list[Frame], converting: Seconds) -> None:
        """Make the maps and record the frames that they are made from."""
        timer, init = Timer(self.runs[0].clock), jitted_init_states if self.is_stacked else jitted_init_state
        self.states, self.configs = start(window, self.runs[0].camera, self.configs, init)
        self.hand_out()
        spent = self._share(timer, converting)
        for run in self.runs:
            record_initialization(run, window, frames, spent)

    def lose(self, frame: Frame, pose: np.ndarray) -> None:
        """Record a frame from which no map can start."""
        for run in self.runs:
            record_before_map(run, frame, pose)

    def advance(self, prediction: Prediction, frame: Frame, converting: Seconds) -> None:
        """Take one step and record it."""
        timer, step = Timer(self.runs[0].clock), jitted_step_states if self.is_stacked else jitted_step
        self.states, infos, self.configs = advance(self.states, prediction, self.runs[0].camera, self.configs, step)
        infos = jax.device_get(infos)
        if not self.is_stacked:  # a stack is taken apart at the end: nobody looks at one of its runs before
            self.hand_out()
        spent = self._share(timer, converting)
        for position, run in enumerate(self.runs):
            record_step(run, frame, self._item(infos, position), spent)

    def hand_out(self) -> None:
        """Give every run its own state and config."""
        for position, run in enumerate(self.runs):
            run.state, run.config = self._item((self.states, self.configs), position)

    def _item(self, tree: Tree, position: int) -> Tree:
        return jax.tree.map(lambda leaf: leaf[position], tree) if self.is_stacked else tree

    def _share(self, timer: Timer, converting: Seconds) -> dict[str, float]:
        """What a run would have spent by itself."""
        return {name: converting.get(name, 0.0) + seconds / len(self.runs) for name, seconds in timer.read().items()}


def map_frames(
    runs: Sequence[MappingRun], dataset: Dataset, prior: Prior, at_once: int = 1, num_threads: int = 1
) -> Iterator[RawView]:
    """Map a sequence; yields on the way what the prior alone says of each frame, for comparison.

    The pose of the first frame is the true one where it is known, else the identity. Frames are read, predicted and
    converted once for all runs. Frames before the first from which a map can start are lost.

    Raises:
        ValueError: there is no such frame.

    Args:
        runs: before their first frame; several have to share a program (`sweep.programs`) and a clock.
        dataset: of all of them.
        prior: likewise.
        at_once: runs that vmap steps together, which keeps an accelerator busy. With 1 every run takes the very
            executable of `slam.step`, so its result does not depend on the others, bit for bit.
        num_threads: such groups that are stepped side by side, which keeps the cores of a CPU busy.
    """
    groups = []
    for row in range(0, len(runs), at_once):
        some = runs[row : row + at_once]
        groups.append(_Group(some, stack([run.config for run in some]) if len(some) > 1 else some[0].config))
    first, anchor, num_tasks = runs[0], None, 0
    with ThreadPoolExecutor(num_threads) as threads:
        for prediction, frames in predictions(dataset, prior, first.config.window_size, first.clock):
            anchor = first_pose(frames) if anchor is None else anchor
            with first.clock.phase("map"):
                for task in _tasks(first, prediction, frames, anchor, groups[0].states is not None):
                    # A task makes the maps, the next is the first step: what one group compiles by itself is there
                    # for the others. Later all are side by side.
                    alone = 1 if num_tasks < 2 or len(groups) == 1 else 0
                    for group in groups[:alone]:
                        task(group)
                    list(threads.map(task, groups[alone:]))
                    num_tasks += groups[0].states is not None
            yield from raw_views(first, prediction, frames, anchor)
    if groups[0].states is None:
        raise ValueError(
            f"none of the {len(first.records)} frames of {dataset.name} {dataset.sequence} has a valid point and a "
            "pose, so there is nothing to start a map from: take frames farther apart or closer together "
            "(dataset.stride=...), larger images (dataset.size=...) or another prior"
        )
    for group in groups:
        group.hand_out()
    for run in runs[1:]:
        run.raw_poses = first.raw_poses


def _tasks(
    run: MappingRun,
    prediction: PriorPrediction,
    frames: Mapping[int, Frame],
    anchor: np.ndarray,
    is_started: bool,
) -> Iterator[Callable[[_Group], None]]:
    """What every group has to do with one prediction, which is converted here."""
    timer = Timer(run.clock)
    if is_started:
        step = to_prediction(prediction, frames, anchor, run.config.observation)
        converting = timer.read()
        yield lambda group: group.advance(step, frames[prediction.window.current], converting)
        return
    since, end = len(run.records), prediction.window.current + 1
    window, usable = to_first_window(prediction, frames, anchor, run.config.observation, since)
    for index in range(since, usable[0] if usable else end):
        yield lambda group, frame=frames[index]: group.lose(frame, anchor)
    if window is None:
        return
    window, following = opening(window, run.config)
    converting, dense = timer.read(), [frames[index] for index in usable]
    yield lambda group: group.start(window, dense, converting)
    for frame, step in zip(dense[1:], following, strict=False):
        yield lambda group, step=step, frame=frame: group.advance(step, frame, {})


def first_pose(frames: Mapping[int, Frame]) -> np.ndarray:
    """T_world_camera of the anchor, (4, 4) float64; the identity where the truth is unknown."""
    truth = frames[0].T_world_camera
    return np.eye(4) if truth is None else np.asarray(truth, np.float64)


def raw_views(
    run: MappingRun, prediction: PriorPrediction, frames: Mapping[int, Frame], anchor: np.ndarray
) -> Iterator[RawView]:
    """Pose and points of each new frame as predicted, under the same mask that the mapping uses."""
    window, min_confidence = prediction.window, float(run.config.observation.min_confidence)
    is_first = not run.raw_poses
    for row, index in enumerate(window.dense):
        if not is_first and index != window.current:
            continue
        pose = anchor @ prediction.T_anchor_view[window.views.index(index)]
        mask = prediction.mask[row] & (prediction.confidence[row] >= min_confidence)
        if not np.isfinite(pose).all():
            pose, mask = (run.raw_poses[-1] if run.raw_poses else anchor), np.zeros_like(mask)
        run.raw_poses.append(pose)
        yield prediction.points[row], mask, frames[index].image, pose
