"""Many settings in one program: configs that differ in traced leaves only are stacked, and vmap steps them together."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import equinox as eqx
import jax
import jaxlie
from jaxtyping import Array, Int

from emgs_jax.observation import Observation, Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.pytree import stack
from emgs_jax.slam import FirstWindow, SlamConfig, SlamState, StepInfo, init_state, run, step


def programs(configs: Sequence[SlamConfig]) -> list[list[int]]:
    """Positions of the configs that can share an executable: their static fields are equal (host side).

    `observation` has to be equal as well: it decides what the predictions become before a step sees them.
    """
    found: dict[tuple, list[int]] = defaultdict(list)
    for position, config in enumerate(configs):
        observation = tuple(float(leaf) for leaf in jax.tree.leaves(config.observation))
        found[jax.tree.structure(config), observation].append(position)
    return list(found.values())


def init_states(
    views: Observation, T_world_views: jaxlie.SE3, camera: Camera, configs: SlamConfig
) -> tuple[SlamState, Int[Array, "s"]]:
    """`slam.init_state` for s stacked configs."""
    return eqx.filter_vmap(lambda config: init_state(views, T_world_views, camera, config))(configs)


def step_states(
    states: SlamState, prediction: Prediction, camera: Camera, configs: SlamConfig
) -> tuple[SlamState, StepInfo]:
    """`slam.step` for s stacked states and configs, which all see one prediction."""
    return eqx.filter_vmap(lambda state, config: step(state, prediction, camera, config))(states, configs)


jitted_init_states = eqx.filter_jit(init_states)
jitted_step_states = eqx.filter_jit(step_states)


def map_configs(
    predictions: Iterable[FirstWindow | Prediction],
    camera: Camera,
    configs: Sequence[SlamConfig],
    on_step: Callable[[SlamState, StepInfo], None] = lambda states, infos: None,
) -> SlamState:
    """`slam.run` for many settings with one compilation (host side).

    Where one setting's map or submap is full, all of them get more room.

    Args:
        predictions: as in `slam.run`; all settings see the same.
        camera: of the full images.
        configs: they differ in traced leaves only, see `programs`.
        on_step: called after each step with the stacked states and infos.

    Returns:
        The states, stacked in the order of `configs`.

    Raises:
        ValueError: the configs do not share a program, or there is no prediction.
    """
    if len(programs(configs)) != 1:
        raise ValueError("the configs differ in a static field or in `observation`: map each of `programs` by itself")
    return run(predictions, camera, stack(configs), on_step, jitted_init_states, jitted_step_states)
