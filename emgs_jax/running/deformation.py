"""Deformation of a run's state after an optimization: map, last frame and its pose follow the nodes."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie

from emgs_jax.existence import ExistenceConfig, merge_all_duplicates
from emgs_jax.ops.pytree import take_rows
from emgs_jax.pose_graph.deform import DeformConfig, deform, deform_view
from emgs_jax.pose_graph.factors import Nodes
from emgs_jax.slam import SlamState

move_map, _move_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)  # a map is compiled for once
_merge = eqx.filter_jit(merge_all_duplicates)


def deform_state(state: SlamState, before: Nodes, after: Nodes, min_std: float, config: DeformConfig) -> SlamState:
    """Deform the map and the last frame from the poses `before` to those `after`."""
    last = state.time - 1
    return replace(
        state,
        map=move_map(state.map, before, after, jnp.asarray(min_std, jnp.float32), config),
        previous=_move_view(state.previous, before, after, last),
        T_world_previous=_moved_pose(state.T_world_previous, before, after, int(last)),
    )


def merge_duplicates_of_state(state: SlamState, nodes: Nodes, depth_noise: float, config: ExistenceConfig) -> SlamState:
    """Merge duplicate surfaces of the whole map, see `merge_all_duplicates`."""
    origins = take_rows(nodes.T_world.translation(), state.map.birth)
    return replace(state, map=_merge(state.map, origins, jnp.asarray(depth_noise, jnp.float32), config))


def _moved_pose(T: jaxlie.SE3, before: Nodes, after: Nodes, row: int) -> jaxlie.SE3:
    """Return the node's new pose; T itself, bit for bit, where the node stays."""
    old, new = before.T_world.wxyz_xyz[row], after.T_world.wxyz_xyz[row]
    return jaxlie.SE3(jnp.where(jnp.all(old == new), T.wxyz_xyz, new))
