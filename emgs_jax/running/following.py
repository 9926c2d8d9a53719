"""A run's state where its frames were moved: the map, the last frame and its pose conform to the nodes."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie

from emgs_jax.existence import ExistenceConfig, merge_layers
from emgs_jax.graph.deform import DeformConfig, deform, deform_view
from emgs_jax.graph.measurements import Nodes
from emgs_jax.ops.pytree import take_rows
from emgs_jax.slam import SlamState

move_map, _move_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)  # a map is compiled for once
_merge = eqx.filter_jit(merge_layers)


def follow(state: SlamState, before: Nodes, after: Nodes, min_std: float, config: DeformConfig) -> SlamState:
    """The state whose map and last frame conform to other poses."""
    last = state.time - 1
    return replace(
        state,
        map=move_map(state.map, before, after, jnp.asarray(min_std, jnp.float32), config),
        previous=_move_view(state.previous, before, after, last),
        T_world_previous=_moved_pose(state.T_world_previous, before, after, int(last)),
    )


def settle(state: SlamState, nodes: Nodes, depth_noise: float, config: ExistenceConfig) -> SlamState:
    """The state whose map has no layers left where visits came to lie on each other, see `merge_layers`."""
    origins = take_rows(nodes.T_world.translation(), state.map.birth)
    return replace(state, map=_merge(state.map, origins, jnp.asarray(depth_noise, jnp.float32), config))


def _moved_pose(T: jaxlie.SE3, before: Nodes, after: Nodes, row: int) -> jaxlie.SE3:
    """The node's new pose; T itself, bit for bit, where the node stays."""
    old, new = before.T_world.wxyz_xyz[row], after.T_world.wxyz_xyz[row]
    return jaxlie.SE3(jnp.where(jnp.all(old == new), T.wxyz_xyz, new))
