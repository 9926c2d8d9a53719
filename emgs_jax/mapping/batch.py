"""Many runs of one sequence: frames are read, predicted and converted once for all of them.

Runs that share a program (their configs differ in traced leaves only) can be stacked, so that vmap steps them together;
threads step runs or stacks side by side.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jaxlie
from jaxtyping import Array, Int

from emgs_jax.data.base import Dataset
from emgs_jax.device.clock import Timer
from emgs_jax.mapping.atlas import with_state
from emgs_jax.mapping.capacity import advance, start
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.event import Event
from emgs_jax.mapping.integrate import seconds_of, update_graph
from emgs_jax.mapping.pipeline import finish_run, map_input, with_outcome
from emgs_jax.mapping.records import records_of
from emgs_jax.mapping.run import MappingRun
from emgs_jax.mapping.tracking import lost_event, start_event, step_event
from emgs_jax.mapping.window_input import RawView, WindowInput, window_inputs
from emgs_jax.observation import Observation, Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.pytree import Tree, stack
from emgs_jax.prior.base import Prior
from emgs_jax.slam import SlamConfig, SlamState, StepInfo, init_state, step


class Stack(NamedTuple):
    """Runs whose states and configs are stacked and stepped by one call; those in `runs` are of the first input."""

    runs: Sequence[MappingRun]
    states: SlamState | None
    configs: SlamConfig


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
) -> Iterator[tuple[Sequence[MappingRun | Stack], Sequence[RawView]]]:
    """Map several runs as `map_frames` does; `finish_together` completes the last groups.

    Args:
        runs: before their first frame, with one clock; their configs share a program.
        at_once: runs that vmap steps together, which keeps an accelerator busy. With 1 every run takes the very
            executable of `map_frames`, so its result does not depend on the others, bit for bit.
        num_threads: runs, or stacks of them, that are stepped side by side, which keeps the cores of a CPU busy.

    Yields:
        Groups of runs after an input, those that are stepped together as a stack; and its frames' raw predictions.

    Raises:
        ValueError: the configs do not share a program, or there is nothing to start a map from.
    """
    if len(programs([run.config for run in runs])) != 1:
        raise ValueError("the configs differ in a static field or in `observation`: map each of `programs` by itself")
    clock = runs[0].clock
    parts = [runs[row : row + at_once] for row in range(0, len(runs), at_once)]
    groups = [make_stack(some) if len(some) > 1 else some[0] for some in parts]
    num_alone = 2  # inputs with a map: the first compiles `init_state`, the second the step, once for all groups
    with ThreadPoolExecutor(num_threads) as threads:
        for window in window_inputs(dataset, prior, runs[0].config, clock):
            with clock.phase("map"):
                alone = [_integrate(group, window) for group in groups[: 1 if num_alone else 0]]
                others = threads.map(lambda group, window=window: _integrate(group, window), groups[len(alone) :])
                groups = [*alone, *others]
            num_alone -= bool(num_alone) and window.prediction is not None
            yield groups, window.raw


def finish_together(groups: Iterable[MappingRun | Stack]) -> list[MappingRun]:
    """Complete the runs of all groups, in their order."""
    runs = [run for group in groups for run in (unstacked(group) if isinstance(group, Stack) else [group])]
    return [finish_run(run) for run in runs]


def _integrate(group: MappingRun | Stack, window: WindowInput) -> MappingRun | Stack:
    return integrate_stack(group, window) if isinstance(group, Stack) else map_input(group, window)[0]


def make_stack(runs: Sequence[MappingRun]) -> Stack:
    """Stack runs before their first frame."""
    return Stack(runs, None, stack([run.config for run in runs]))


def integrate_stack(group: Stack, window: WindowInput) -> Stack:
    """Integrate one input into all runs; where the map or submap of one is full, all capacities grow."""
    runs, states, configs = group
    timer, camera = Timer(runs[0].clock), runs[0].camera
    match window.prediction:
        case None:
            return group._replace(runs=[_with_event(run, window, lost_event(run.atlas, window)) for run in runs])
        case FirstWindow() as first:
            group, infos = Stack(runs, *start(first, camera, configs, init_states)), None
        case prediction:
            states, infos, configs = advance(states, prediction, camera, configs, step_states)
            group, infos = Stack(runs, states, configs), jax.device_get(infos)
    seconds = seconds_of(window, timer, len(runs))

    def with_outcome(position: int, run: MappingRun) -> MappingRun:
        event = start_event(run.atlas, window) if infos is None else step_event(run.atlas, _item(infos, position))
        return _with_event(run, window, replace(event, seconds=seconds))

    return group._replace(runs=[with_outcome(position, run) for position, run in enumerate(unstacked(group))])


def _with_event(run: MappingRun, window: WindowInput, event: Event) -> MappingRun:
    """Write what became of an input's frames into pose graph and log."""
    run = replace(run, records=(*run.records, *records_of(window, event)))
    return with_outcome(run, update_graph(run.atlas, window, event), event)


def unstacked(group: Stack) -> list[MappingRun]:
    """Return the runs, each with its own state and config."""
    own = (_item((group.states, group.configs), position) for position in range(len(group.runs)))
    return [replace(run, atlas=with_state(run.atlas, *both)) for run, both in zip(group.runs, own, strict=True)]


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
