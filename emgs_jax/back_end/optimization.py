"""Optimize the pose graph and deform the state of a run: map, last frame and its pose follow the nodes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.back_end.factors import loop_factor, measured_again, stack_factors
from emgs_jax.back_end.state import BackEnd, Closure, Node
from emgs_jax.device.arrays import to_se3
from emgs_jax.existence import ExistenceConfig, merge_all_duplicates
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.layers import fuse_sheets, one_layer
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import take_rows
from emgs_jax.pose_graph.deform import DeformConfig, deform, deform_view
from emgs_jax.pose_graph.factors import Nodes, PoseGraph
from emgs_jax.pose_graph.optimize import optimize
from emgs_jax.pose_graph.problem import bucket
from emgs_jax.registration.pose_estimate import rescale_estimate
from emgs_jax.registration.rigid import scale_translation
from emgs_jax.slam import SlamState

move_map, _move_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)  # compiled once per size of the map
_merge, _one_layer = eqx.filter_jit(merge_all_duplicates), eqx.filter_jit(one_layer)


@full_precision
def close_loops(end: BackEnd, state: SlamState, loops: Sequence[LoopMeasurement] = ()) -> tuple[BackEnd, SlamState]:
    """Optimize with `loops` as additional factors and deform the map; a refused solution moves nothing."""
    factors = [*end.factors, *map(loop_factor, loops)]
    before, solver = nodes_of(end, end.active), end.config.solver
    if not end.has_one_unit:  # the scales are not all about 1
        solver = replace(solver, scale_std=jnp.asarray(math.inf))
    after, info = optimize(PoseGraph(before, stack_factors(factors)), solver)
    end = replace(end, closures=[*end.closures, Closure(len(end.nodes) - 1, tuple(loops), info)])
    if info.reason:
        return end, state
    found = (
        np.asarray(values, np.float64)[: len(end.nodes)] for values in (after.T_world.as_matrix(), after.log_scale)
    )
    nodes = tuple(
        replace(node, pose=pose, log_scale=scale) for node, pose, scale in zip(end.nodes, *found, strict=True)
    )
    end = replace(end, factors=factors, accepted=[*end.accepted, *loops], nodes=nodes)
    change = jnp.mean(after.log_scale - before.log_scale, where=before.valid)
    state = replace(state, estimate=rescale_estimate(state.estimate, jnp.exp(change)))
    return end, deform_state(state, before, after, end.min_std, end.config.deform)


def follow_prior(
    end: BackEnd, state: SlamState, adjusted: Mapping[int, np.ndarray], T_world_anchor: np.ndarray
) -> tuple[BackEnd, SlamState]:
    """Move nodes and map with the poses that the prior has changed.

    What a pose was first estimated to be beside its prediction stays; corrections by loops are replaced.

    Args:
        adjusted: by frame, T_anchor_camera (4, 4) as the prior knows it now.
    """

    def moved(node: Node) -> Node:
        new, old = adjusted.get(node.frame), node.predicted
        if node.submap != end.active or new is None or old is None or not np.isfinite([new, old]).all():
            return node
        beside = np.linalg.inv(T_world_anchor @ old) @ node.online
        return replace(node, pose=T_world_anchor @ new @ beside)

    after = replace(end, nodes=tuple(map(moved, end.nodes)))
    stays = [node is before for node, before in zip(after.nodes, end.nodes, strict=True)]
    predicted = [node.predicted if stay else adjusted[node.frame] for node, stay in zip(end.nodes, stays, strict=True)]
    known = after.poses, after.log_scales, predicted
    factors = [one if stays[one.a] and stays[one.b] else measured_again(one, *known) for one in end.factors]
    nodes = nodes_of(end, end.active), nodes_of(after, end.active)
    return replace(after, factors=factors), deform_state(state, *nodes, end.min_std, end.config.deform)


def nodes_of(end: BackEnd, submap_id: int | None = None) -> Nodes:
    """Stack all nodes, of which only those of a submap are valid if it is given; padded to a power of two."""
    count = len(end.nodes)
    size = bucket(count)
    poses = to_se3(np.stack([*end.poses, *[np.eye(4)] * (size - count)]))
    scales = jnp.asarray([*end.log_scales, *[0.0] * (size - count)], jnp.float32)
    is_valid = [submap_id in (None, node.submap) for node in end.nodes]
    return Nodes(poses, scales, jnp.asarray(is_valid + [False] * (size - count)))


def deform_state(state: SlamState, before: Nodes, after: Nodes, min_std: float, config: DeformConfig) -> SlamState:
    """Deform the map and the last frame from the poses `before` to `after`; earlier looks scale with the last frame."""
    last = state.time - 1
    looks, growth = state.looks, jnp.exp(after.log_scale[last] - before.log_scale[last])
    if looks is not None:
        poses = jax.vmap(scale_translation, (0, None))(looks.T_previous_look, growth)
        points, depth = growth * looks.points, growth * looks.depth
        looks = replace(looks, points=points, depth=depth, T_previous_look=poses)
    return replace(
        state,
        map=move_map(state.map, before, after, jnp.asarray(min_std, jnp.float32), config),
        previous=_move_view(state.previous, before, after, last),
        T_world_previous=_moved_pose(state.T_world_previous, before, after, int(last)),
        looks=looks,
    )


def merge_duplicates_of_state(state: SlamState, end: BackEnd, config: ExistenceConfig) -> SlamState:
    """Merge duplicate surfaces of the whole map, see `merge_all_duplicates`."""
    noise = depth_noise_of(end)
    return state if noise is None else replace(state, map=_merge(state.map, _origins(end, state), noise, config))


def fuse_sheets_of_state(state: SlamState, end: BackEnd, config: ExistenceConfig) -> SlamState:
    """Fuse the sheets of the surfaces of a whole map, see `fuse_sheets`."""
    noise = depth_noise_of(end)
    if noise is None:
        return state
    centers = np.zeros((bucket(len(end.nodes)), 3), np.float32)
    centers[: len(end.nodes)] = np.stack(end.poses)[:, :3, 3]
    return replace(state, map=_fuse_sheets(state.map, jnp.asarray(centers), noise, config))


@eqx.filter_jit
def _fuse_sheets(
    map: GaussianMap, centers: Float[Array, "k 3"], depth_noise: Float[Array, ""], config: ExistenceConfig
) -> GaussianMap:
    """Do `fuse_sheets` with the centres of all nodes; one program, for every run ends with it."""
    return fuse_sheets(map, take_rows(centers, map.birth), depth_noise, config)


def one_layer_of_state(state: SlamState, end: BackEnd, is_other: Sequence[bool], config: ExistenceConfig) -> SlamState:
    """Make one layer of the Gaussians of some nodes and those of the others, see `one_layer`."""
    noise, is_other = depth_noise_of(end), jnp.asarray(is_other)[state.map.birth]
    if noise is None:
        return state
    return replace(state, map=_one_layer(state.map, is_other, _origins(end, state), noise, config))


def depth_noise_of(end: BackEnd) -> Float[Array, ""] | None:
    """Compute the median ν of the nodes that were registered to the map; None without any."""
    noise = [node.depth_noise for node in end.nodes if node.is_placed and node.depth_noise is not None]
    return jnp.asarray(np.median(noise), jnp.float32) if noise else None


def _origins(end: BackEnd, state: SlamState) -> Float[Array, "n 3"]:
    """Look up the centre of the camera that made each Gaussian, world frame."""
    return take_rows(nodes_of(end, end.active).T_world.translation(), state.map.birth)


def _moved_pose(T: jaxlie.SE3, before: Nodes, after: Nodes, row: int) -> jaxlie.SE3:
    """Return the node's new pose; T itself, bit for bit, if the node stays."""
    old, new = before.T_world.wxyz_xyz[row], after.T_world.wxyz_xyz[row]
    return jaxlie.SE3(jnp.where(jnp.all(old == new), T.wxyz_xyz, new))
