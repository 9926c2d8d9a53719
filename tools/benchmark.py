"""What each stage of a step takes, compilation apart: `python -m tools.benchmark [words of a run]`.

The first frames of a sequence are the data. Stages take turns, so that what else the machine does meets all of them;
times are medians and ranges.
"""

import itertools
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax

from emgs_jax.config.configure import build, build_dataset, build_prior, compose
from emgs_jax.device.clock import Clock
from emgs_jax.mapping.capacity import start
from emgs_jax.mapping.convert import to_camera, to_first_window, to_prediction
from emgs_jax.mapping.window_input import first_pose, predictions
from emgs_jax.observation import Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.executable import calling
from emgs_jax.ops.precision import full_precision
from emgs_jax.report.columns import Table, aligned
from emgs_jax.slam import SlamConfig, SlamState, step

TURNS = 5


class Data(NamedTuple):
    """What a step takes: the map of the first window, and the frame after it."""

    state: SlamState
    prediction: Prediction
    camera: Camera
    config: SlamConfig


def load(*words: str) -> Data:
    """The data of a run with these words. Raises ValueError where frames are missing."""
    config = compose("slam.window_size=3", *words)
    dataset, slam = build_dataset(config), build(config, "slam")
    calls = list(itertools.islice(predictions(dataset, build_prior(config, dataset), slam.window_size, Clock()), 2))
    if len(calls) < 2:
        raise ValueError(f"a step needs {slam.window_size + 1} frames, {dataset.sequence} has {len(dataset)}")
    anchor, camera = first_pose(calls[0][1]), to_camera(dataset)
    state, grown = start(to_first_window(*calls[0], anchor, slam.observation)[0], camera, slam)
    return Data(state, to_prediction(*calls[1], anchor, slam.observation), camera, grown)


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it returns."""
    begin = time.perf_counter()
    found = jax.block_until_ready(call())
    return time.perf_counter() - begin, found


def in_turns(calls: Mapping[str, Callable[[], Any]], first: Mapping[str, float], turns: int) -> Iterator[list[str]]:
    """A line for each: its name, the seconds of its first call beyond those of a later one, and these in ms."""
    taken = [{name: timed(call)[0] for name, call in calls.items()} for _ in range(turns)]
    for name in calls:
        seconds = [turn[name] for turn in taken]
        middle, low, high = statistics.median(seconds), min(seconds), max(seconds)
        yield [name, f"{max(first[name] - middle, 0):.1f}", f"{1e3 * middle:.3g} ({1e3 * low:.3g}–{1e3 * high:.3g})"]


def stages(data: Data, turns: int = TURNS) -> Table:
    """Every executable of a step, called with what those before it give, and the whole step."""
    calls, first = {}, {}

    def note(executable: Any, *arguments: Any) -> Any:
        name = executable.__wrapped__.__name__.strip("_").replace("_", " ")
        calls[name] = partial(full_precision(executable), *arguments)
        first[name], found = timed(calls[name])
        return found

    with calling(note):
        step(*data)
    calls["whole step"] = partial(step, *data)
    first["whole step"] = sum(first.values())
    return Table(["stage", "compile [s]", "run [ms]"], list(in_turns(calls, first, turns)))


def main() -> None:
    device = jax.devices()[0]
    print(f"{device.device_kind} ({device.platform}), {os.cpu_count()} CPU cores, jax {jax.__version__}")
    print(aligned(stages(load(*sys.argv[1:]))))


if __name__ == "__main__":
    main()
