"""Maps that grow: whatever finds the map or the submap full is repeated with twice the room."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from emgs_jax.gaussian_map import grow
from emgs_jax.observation import Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.running.convert import FirstWindow
from emgs_jax.slam import Overflow, SlamConfig, SlamState, StepInfo, init_state, step


def start(
    first: FirstWindow, camera: Camera, config: SlamConfig, init: Callable = init_state
) -> tuple[SlamState, SlamConfig]:
    """State of the first window, and the config with the capacity that it needs.

    Args:
        first: what the map is made from.
        camera: of the full images.
        config: all stages; capacities are where to start.
        init: `init_state`, or what does the same for stacked configs.
    """
    state, overflow = init(first.views, first.T_world_views, camera, config)
    while jnp.any(overflow > 0):
        config = with_room(config, Overflow(overflow, jnp.zeros((), int), jnp.zeros((), int)))
        state, overflow = init(first.views, first.T_world_views, camera, config)
    return state, config


def advance(
    state: SlamState, prediction: Prediction, camera: Camera, config: SlamConfig, step: Callable = step
) -> tuple[SlamState, StepInfo, SlamConfig]:
    """One step; a map or submap that is full is doubled and the frame repeated.

    That gives the same map as starting with the larger capacity. Splats that find their tile full are only counted:
    they change what is drawn, not what is kept. `step` is `slam.step`, or what does the same for stacked states.
    """
    new, info = step(state, prediction, camera, config)
    while jnp.any((info.overflow.map > 0) | (info.overflow.submap > 0)):
        config = with_room(config, info.overflow)
        if config.submap.map_capacity > state.map.weight.shape[-1]:
            state = eqx.tree_at(lambda s: s.map, state, grow(state.map, config.submap.map_capacity))
        new, info = step(state, prediction, camera, config)
    return new, info, config


def with_room(config: SlamConfig, overflow: Overflow) -> SlamConfig:
    """The config with doubled capacities where rows did not fit; each new size compiles once."""
    submap = config.submap
    map_factor, submap_factor = (2 if jnp.any(lost > 0) else 1 for lost in (overflow.map, overflow.submap))
    capacities = submap.map_capacity * map_factor, submap.submap_capacity * submap_factor
    return replace(config, submap=replace(submap, map_capacity=capacities[0], submap_capacity=capacities[1]))
