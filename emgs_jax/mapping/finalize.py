"""The end of a run: what its last frames saw move, the first frame's own covariance, and the unit of the map.

During a run the unit is that of the first inference; at the end it becomes the mean unit of all inferences. During a
run covariances of poses are relative to the first frame; at the end its own covariance is added.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.back_end.optimization import fuse_sheets_of_state
from emgs_jax.back_end.state import BackEnd, transform_nodes
from emgs_jax.device.arrays import on_device
from emgs_jax.existence import ExistenceConfig, Seen, take_back
from emgs_jax.gaussian_map import GaussianMap, transform_rows
from emgs_jax.geometry import Sim3, seen_from
from emgs_jax.localization import LocalizationConfig
from emgs_jax.mapping.atlas import Atlas, with_state
from emgs_jax.motion import Looks
from emgs_jax.observation import Observation, depth_in
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.registration.pose_estimate import PoseEstimate, rescale_estimate
from emgs_jax.registration.pose_noise import LEAST_NOISE, axis_std
from emgs_jax.slam import SlamConfig, SlamState, as_seen


def end_looks(state: SlamState, camera: Camera, config: SlamConfig) -> tuple[SlamState, list[Seen]]:
    """Withdraw the last frames' evidence for Gaussians of things that moved, since no later frame will come.

    Args:
        state: with looks.
        camera: of the full images.

    Returns:
        The state without looks, and these frames, on the host.
    """
    map, seen = _end_looks(state, downscale(camera, config.observation.thin), config.existence)
    seen = jax.device_get(seen)
    each = [jax.tree.map(lambda leaf, row=row: leaf[row], seen) for row in np.flatnonzero(seen.time >= 0)]
    return replace(state, map=map, looks=None), each


def end_looks_of(atlas: Atlas, number: int) -> tuple[Atlas, list[Seen]]:
    """Apply `end_looks` to a submap that no further frame is fused into; a frozen map stays."""
    submap = atlas.submaps[number]
    state, seen, looks = replace(submap.state, looks=None), [], submap.state.looks
    if looks is not None and (np.asarray(looks.time) >= 0).any():
        state, seen = end_looks(submap.state, atlas.camera, atlas.config)
        state = replace(state, map=submap.state.map) if submap.is_frozen else state
    return replace(atlas, submaps={**atlas.submaps, number: replace(submap, state=state)}), seen


@eqx.filter_jit
def _end_looks(state: SlamState, view: Camera, config: ExistenceConfig) -> tuple[GaussianMap, Seen]:
    def end(map: GaussianMap, look: Looks) -> tuple[GaussianMap, Seen]:
        seen = as_seen(look, state.T_world_previous, state.estimate.depth_noise)
        return take_back(map, seen, view, config), seen

    return jax.lax.scan(end, state.map, state.looks, reverse=True)


def with_sheets_fused(atlas: Atlas) -> Atlas:
    """Apply `fuse_sheets` to the map of a run that ends; submaps apart stay, and so does a frozen map."""
    if atlas.state is None:
        return atlas
    state = fuse_sheets_of_state(atlas.state, atlas.graph, atlas.config.existence)
    return with_state(atlas, state, atlas.config)


def own_covariance(state: SlamState, config: LocalizationConfig) -> np.ndarray:
    """Estimate the covariance (6, 6) of the first frame's pose, in its own axes, from repeated predictions.

    The first frame is at the end of its window, whereas the frames in the middle determine the map. Between them lies
    half a window of motions with independent errors, whose sum enters all later poses. It is not known when the map
    starts, because only the repeated predictions of the whole run show how noisy motions are. 0 without any repeated
    prediction.

    Args:
        state: after the last step; m of its map.
    """
    estimate, last = state.estimate, state.previous
    is_known = np.asarray(last.valid).any() and np.asarray(estimate.repeats.counts)[0] > 0
    if not is_known or float(config.pose_shared) >= 1:
        return np.zeros((6, 6))
    std = _own_std(estimate, last, state.T_world_previous, (config.icp.prior_information, config.pose_shared))
    return np.diag(0.5 * float(config.num_shared) * np.asarray(std, np.float64) ** 2)


@eqx.filter_jit
def _own_std(
    estimate: PoseEstimate,
    last: Observation,
    T_world_last: jaxlie.SE3,
    known: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, "6"]:
    mean_depth = jnp.mean(depth_in(T_world_last, last), where=last.valid)
    guess = jnp.maximum(estimate.depth_noise, LEAST_NOISE), mean_depth
    return axis_std(estimate.repeats, jnp.zeros((2, 2)), *guess, *known)[0]


def with_first_frame(atlas: Atlas, first: np.ndarray) -> tuple[Atlas, np.ndarray | None]:
    """Add `own_covariance`, seen from each frame, to those of a run that ends; frames in a saved map have none.

    Args:
        first: pose of the first frame, (4, 4).

    Returns:
        The atlas, and the covariance of the first frame that was added, or None.
    """
    graph = atlas.graph
    rows = [row for row in _active_rows(graph) if graph.nodes[row].covariance is not None]
    if atlas.state is None or graph.first_node or not rows:
        return atlas, None
    own = own_covariance(atlas.state, atlas.config.localization)
    if not own.any():
        return atlas, None
    nodes = list(graph.nodes)
    for row, added in zip(rows, seen_from(own, first, np.stack([nodes[row].pose for row in rows])), strict=True):
        nodes[row] = replace(nodes[row], covariance=nodes[row].covariance + added)
    return replace(atlas, graph=replace(graph, nodes=tuple(nodes))), own


def _active_rows(graph: BackEnd) -> list[int]:
    """Find the nodes of the active submap; the others are in worlds and units of their own."""
    return [row for row, node in enumerate(graph.nodes) if node.submap == graph.active]


def in_prior_unit(state: SlamState, origin: np.ndarray) -> SlamState:
    """Rescale a state by e^−γ about `origin`, so that the scales of all predictions are 1 on average.

    γ is the mean logarithm of the scales (`PoseEstimate.log_scale`): a length of a prediction times its scale is one of
    the map. The mean of all predictions is more accurate than the first, which gave the map its unit. A state with γ =
    0 stays as it is.

    Args:
        origin: (3,) of the first camera.
    """
    if not state.estimate.log_scale:
        return state
    factor = np.exp(-float(state.estimate.log_scale))
    return _rescaled(state, *on_device((np.float32(factor), np.asarray(origin, np.float32))))


def rescale_atlas(atlas: Atlas, first: np.ndarray) -> Atlas:
    """Apply `in_prior_unit` to a run that ends, including its pose graph, about the `first` camera's pose (4, 4).

    A saved map keeps its unit, and so does a map of joined submaps, because the mean is only over the last one's
    inferences. Submaps that were never joined keep their worlds.
    """
    graph, state = atlas.graph, atlas.state
    if state is None or graph.first_node or not graph.has_one_unit or not state.estimate.log_scale:
        return atlas
    similarity = Sim3.about(first[:3, 3], np.exp(-float(state.estimate.log_scale)))
    graph = transform_nodes(graph, _active_rows(graph), similarity)
    return with_state(replace(atlas, graph=graph), in_prior_unit(state, first[:3, 3]), atlas.config)


@eqx.filter_jit
def _rescaled(state: SlamState, factor: Float[Array, ""], center: Float[Array, "3"]) -> SlamState:
    """Multiply all lengths of a state by `factor`, about a point."""

    def placed(points: jnp.ndarray) -> jnp.ndarray:
        return center + factor * (points - center)

    T = state.T_world_previous
    return replace(
        state,
        map=transform_rows(state.map, placed(state.map.gaussians.means), jnp.eye(3), factor),
        previous=eqx.tree_at(lambda o: o.points, state.previous, placed(state.previous.points)),
        T_world_previous=jaxlie.SE3.from_rotation_and_translation(T.rotation(), placed(T.translation())),
        estimate=rescale_estimate(state.estimate, factor),
    )
