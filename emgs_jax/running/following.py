"""A run's state where its frames were moved: the map, the last frame and its pose conform to the nodes."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie

from emgs_jax.graph.deform import DeformConfig, deform, deform_view
from emgs_jax.graph.measurements import Nodes
from emgs_jax.slam import SlamState

move_map, _move_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)  # a map is compiled for once


def follow(state: SlamState, before: Nodes, after: Nodes, min_std: float, config: DeformConfig) -> SlamState:
    """The state whose map and last frame conform to other poses."""
    last = state.time - 1
    return replace(
        state,
        map=move_map(state.map, before, after, jnp.asarray(min_std, jnp.float32), config),
        previous=_move_view(state.previous, before, after, last),
        T_world_previous=_moved_pose(state.T_world_previous, before, after, int(last)),
    )


def _moved_pose(T: jaxlie.SE3, before: Nodes, after: Nodes, row: int) -> jaxlie.SE3:
    """The node's new pose; T itself, bit for bit, where the node stays."""
    old, new = before.T_world.wxyz_xyz[row], after.T_world.wxyz_xyz[row]
    return jaxlie.SE3(jnp.where(jnp.all(old == new), T.wxyz_xyz, new))
