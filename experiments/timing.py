"""What the benchmark times: a first window with the step after it, and candidates that take turns on them."""

import itertools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from omegaconf import DictConfig

from emgs_jax.config.configure import build, build_dataset, build_prior
from emgs_jax.device.clock import Clock
from emgs_jax.mapping.capacity import start
from emgs_jax.mapping.convert import FirstWindow, to_camera, to_first_window, to_prediction
from emgs_jax.mapping.window_input import first_pose, predictions
from emgs_jax.observation import Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.slam import SlamConfig, SlamState


@dataclass(frozen=True)
class Data:
    """The first window, the map of all its views, and the step after it.

    Args:
        camera: of the full images.
        config: with the capacity that the map needs.
        true_poses: T_world_camera (views, 4, 4) of the first window.
    """

    camera: Camera
    config: SlamConfig
    first: FirstWindow
    state: SlamState
    prediction: Prediction
    true_poses: np.ndarray


def load(config: DictConfig) -> Data:
    """The data of a config. Raises ValueError where frames are missing."""
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    slam = build(config, "slam")
    calls = list(itertools.islice(predictions(dataset, prior, slam.window_size, Clock()), 2))
    frames = calls[0][1] if calls else {}
    if len(calls) < 2 or any(frames[row].T_world_camera is None for row in range(slam.window_size)):
        raise ValueError(
            f"the benchmark needs {slam.window_size + 1} frames with true poses, {dataset.name} {dataset.sequence} has "
            f"{len(dataset)} frames: use dataset=synthetic"
        )
    anchor, camera = first_pose(frames), to_camera(dataset)
    first = to_first_window(*calls[0], anchor, slam.observation)[0]
    state, grown = start(first, camera, slam)
    poses = [frames[row].T_world_camera for row in calls[0][0].window.dense]
    prediction = to_prediction(*calls[1], anchor, slam.observation)
    return Data(camera, grown, first, state, prediction, np.stack(poses))


@dataclass(frozen=True)
class Candidate:
    """Something to time.

    Args:
        call: returns when its result is there.
        compile_seconds: of tracing and compiling; None where nothing is compiled.
        facts: what else was found, for example errors, sizes and ratios.
    """

    call: Callable[[], Any]
    compile_seconds: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Timing:
    """One row of a table: a candidate's seconds in every turn, and what is known of it."""

    part: str
    name: str
    seconds: list[float]
    compile_seconds: float | None
    facts: dict[str, Any]


def called(verb: Callable, *arguments: Any) -> Candidate:
    """`verb` as users call it: its first call compiles, and what that takes longer than a second one is compilation."""
    call = lambda: jax.block_until_ready(verb(*arguments))  # noqa: E731
    first, second = _seconds(call), _seconds(call)
    return Candidate(call, max(first - second, 0.0))


def _seconds(call: Callable) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def interleaved(part: str, candidates: Mapping[str, Candidate], repetitions: int) -> list[Timing]:
    """Time all candidates in turns, so that what else the machine does meets all; the first turn does not count."""
    turns = [{name: _seconds(one.call) for name, one in candidates.items()} for _ in range(repetitions + 1)][1:]
    return [
        Timing(part, name, [turn[name] for turn in turns], one.compile_seconds, dict(one.facts))
        for name, one in candidates.items()
    ]


def compare(timings: Sequence[Timing], reference: str) -> list[Timing]:
    """Add to every other row how many times as long as it the reference takes: median and range over the turns."""
    (base,) = (timing for timing in timings if timing.name == reference)
    for timing in timings:
        if timing is not base:
            turns = zip(base.seconds, timing.seconds, strict=True)
            timing.facts["times_faster_than"] = {reference: spread([theirs / ours for theirs, ours in turns])}
    return list(timings)


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Median, smallest and largest."""
    return statistics.median(values), min(values), max(values)
