"""Many runs of one sequence: frames are read, predicted and converted once for all of them.

Runs that share a program (their configs differ in traced leaves only) can be stacked, so that vmap steps them together;
threads step runs or stacks side by side.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jaxlie
from jaxtyping import Array, Int

from emgs_jax.data.base import Dataset
from emgs_jax.observation import Observation, Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.pytree import Tree, stack
from emgs_jax.prior.base import Prior
from emgs_jax.running.capacity import advance, start
from emgs_jax.running.clock import Timer
from emgs_jax.running.convert import FirstWindow
from emgs_jax.running.first_frame import with_first_frame
from emgs_jax.running.pipeline import integrate_input, seconds_of
from emgs_jax.running.record import MappingRun, record_lost, record_start, record_step
from emgs_jax.running.unit import rescale_run
from emgs_jax.running.window_input import RawView, WindowInput, window_inputs
from emgs_jax.slam import SlamConfig, SlamState, StepInfo, init_state, step


def programs(configs: Sequence[SlamConfig]) -> list[list[int]]:
    """Group the positions of configs that can share an executable: their static fields are equal.

    `observation` has to be equal as well: it decides what the predictions become before a step sees them.
    """
    found: dict[tuple, list[int]] = defaultdict(list)
    for position, config in enumerate(configs):
        observation = tuple(float(leaf) for leaf in jax.tree.leaves(config.observation))
        found[jax.tree.structure(config), observation].append(position)
    return list(found.values())


def map_together(
    runs: Sequence[MappingRun], dataset: Dataset, prior: Prior, at_once: int = 1, num_threads: int = 1
) -> Iterator[RawView]:
    """Map several runs as `map_frames` does; yields the raw predictions of each frame on the way.

    Args:
        runs: before their first frame, with one clock; their configs share a program.
        dataset: of all of them.
        prior: likewise.
        at_once: runs that vmap steps together, which keeps an accelerator busy. With 1 every run takes the very
            executable of `map_frames`, so its result does not depend on the others, bit for bit.
        num_threads: runs, or stacks of them, that are stepped side by side, which keeps the cores of a CPU busy.

    Raises:
        ValueError: the configs do not share a program, or there is nothing to start a map from.
    """
    if len(programs([run.config for run in runs])) != 1:
        raise ValueError("the configs differ in a static field or in `observation`: map each of `programs` by itself")
    clock = runs[0].clock
    groups = [runs[row : row + at_once] for row in range(0, len(runs), at_once)]
    stacks = [Stack(some) for some in groups if len(some) > 1]
    integrators = [
        *(group.integrate for group in stacks),
        *(partial(integrate_input, some[0]) for some in groups if len(some) == 1),
    ]
    num_alone = 2  # inputs with a map: the first compiles `init_state`, the second the step, once for all groups
    with ThreadPoolExecutor(num_threads) as threads:
        for window in window_inputs(dataset, prior, runs[0].config, clock):
            with clock.phase("map"):
                alone = integrators[: 1 if num_alone else 0]
                for integrate in alone:
                    integrate(window)
                list(threads.map(lambda one, window=window: one(window), integrators[len(alone) :]))
            num_alone -= bool(num_alone) and window.prediction is not None
            yield from window.raw
    for group in stacks:
        group.hand_out()
    for run in runs:
        with_first_frame(run)
        rescale_run(run)


class Stack:
    """Runs whose states and configs are stacked and stepped by one call.

    The runs get their states from `hand_out`, at the end only.
    """

    def __init__(self, runs: Sequence[MappingRun]) -> None:
        self._runs, self._configs = runs, stack([run.config for run in runs])
        self._states: SlamState | None = None

    def integrate(self, window: WindowInput) -> None:
        """Integrate one input into all runs; where the map or submap of one is full, all capacities grow."""
        timer, camera = Timer(self._runs[0].clock), self._runs[0].camera
        match window.prediction:
            case None:
                for run in self._runs:
                    record_lost(run, window)
            case FirstWindow() as first:
                self._states, self._configs = start(first, camera, self._configs, init_states)
                self.hand_out()
                for run in self._runs:
                    record_start(run, window, seconds_of(window, timer, len(self._runs)))
            case Prediction() as prediction:
                stepped = advance(self._states, prediction, camera, self._configs, step_states)
                self._states, infos, self._configs = stepped[0], jax.device_get(stepped[1]), stepped[2]
                for position, run in enumerate(self._runs):
                    record_step(run, window, _item(infos, position), seconds_of(window, timer, len(self._runs)))

    def hand_out(self) -> None:
        """Give every run its own state and config."""
        for position, run in enumerate(self._runs):
            run.state, run.config = _item((self._states, self._configs), position)


def _item(tree: Tree, position: int) -> Tree:
    return jax.tree.map(lambda leaf: leaf[position], tree)


def init_states(
    views: Observation, T_world_views: jaxlie.SE3, camera: Camera, configs: SlamConfig
) -> tuple[SlamState, Int[Array, "s"]]:
    """`slam.init_state` for s stacked configs."""
    return eqx.filter_vmap(lambda config: init_state(views, T_world_views, camera, config))(configs)


def step_states(
    states: SlamState, prediction: Prediction, camera: Camera, configs: SlamConfig
) -> tuple[SlamState, StepInfo]:
    """`slam.step` for s stacked states and configs, which all see one prediction; its executables, each under vmap."""
    return eqx.filter_vmap(lambda state, config: step(state, prediction, camera, config))(states, configs)
