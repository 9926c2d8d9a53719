"""The maps of a run, whose relative poses may be unknown, and how a frame is found in one of them.

A prior that has lost the first view may continue in a world of its own. There a new map starts, and the one before
becomes inactive. Where a frame fits an inactive map, the similarity between its two poses joins both submaps: the newer
one moves, poses, scales and Gaussians. A saved map is an inactive submap until a frame is found in it.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.back_end.factors import Factor
from emgs_jax.back_end.loops import relocalize_frame
from emgs_jax.back_end.optimization import deform_state, move_map, nodes_of
from emgs_jax.back_end.saved_map import SavedMap
from emgs_jax.back_end.state import BackEnd, Node, transform_nodes
from emgs_jax.device.arrays import to_matrix, to_se3
from emgs_jax.gaussian_map import grow
from emgs_jax.geometry import Sim3, scale_covariance, scale_pose
from emgs_jax.loop_closure.relocalization import NO_CANDIDATE, RelocalizationConfig, RelocalizedPose
from emgs_jax.mapping.capacity import add_map, advance, start
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.event import Event
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.mapping.world import (
    World,
    anchor_motion,
    anchor_world,
    as_step_prediction,
    is_related,
    move_prediction,
    place_world,
    step_prediction,
)
from emgs_jax.motion import no_looks
from emgs_jax.observation import Observation, Prediction, no_covariance, transform, unknown_scale
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.registration.pose_estimate import exact_estimate, rescale_estimate
from emgs_jax.slam import SlamConfig, SlamState, StepInfo

FINE_POSE = "fine_pose"  # reason of a rejection: at the relocalized pose the frame does not fit the map


@dataclass(frozen=True)
class Submap:
    """A map whose pose relative to others is not known.

    Args:
        state: of its SLAM; of a map in which no frame was found yet only map and depth noise say anything.
        is_frozen: True in localization mode: the map and its pose graph stay as they are.
        worlds: of the prior that lie in it and that the run has left, by their number.
    """

    state: SlamState
    is_frozen: bool = False
    worlds: Mapping[int, World] = field(default_factory=dict)


def unvisited(saved: SavedMap, camera: Camera, config: SlamConfig) -> Submap:
    """Make the submap of a saved map, in which no frame of this camera was found yet."""
    view, time = downscale(camera, config.observation.thin), jnp.asarray(len(saved.back_end.nodes), jnp.int32)
    size, width = view.width * view.height, saved.map.gaussians.features.shape[-1]
    estimate = replace(exact_estimate(), depth_noise=jnp.asarray(saved.depth_noise, jnp.float32))
    arrays = (jnp.zeros((size, columns)) for columns in (3, 3, 3, width))
    nothing = Observation(*arrays, jnp.zeros(size), jnp.zeros(size, bool))
    known = nothing, jaxlie.SE3.identity(), estimate, time, no_looks(nothing, config.motion)
    return Submap(SlamState(saved.map, *known), saved.is_fixed)


@dataclass(frozen=True)
class Atlas:
    """All that the mapping knows after an input. Nothing of it is ever changed in place: each input makes a new one.

    Args:
        config: its capacities grow with the maps.
        submaps: by their number.
        graph: poses of all frames, and the number of the active submap, where the camera is.
        world: of the prior, where the camera is.
        num_lost: frames up to the last one since one was placed in a map.
    """

    camera: Camera
    config: SlamConfig
    graph: BackEnd
    submaps: Mapping[int, Submap] = field(default_factory=dict)
    world: World = World()
    num_lost: int = 0

    @property
    def active(self) -> Submap | None:
        """The submap where the camera is; None before it is in any."""
        return None if self.graph.active is None else self.submaps.get(self.graph.active)

    @property
    def state(self) -> SlamState | None:
        """State of the active submap."""
        return None if self.active is None else self.active.state

    @property
    def is_frozen(self) -> bool:
        """True in localization mode."""
        return any(submap.is_frozen for submap in self.submaps.values())


def with_state(atlas: Atlas, state: SlamState, config: SlamConfig) -> Atlas:
    """Set the state of the active submap, and the config with the capacity that it needs; a frozen map stays."""
    number, before = atlas.graph.active, atlas.active or Submap(state)
    if before.is_frozen:
        map, capacity = before.state.map, config.submap.map_capacity
        state = replace(state, map=grow(map, capacity) if capacity > map.weight.shape[0] else map)
    return replace(atlas, submaps={**atlas.submaps, number: replace(before, state=state)}, config=config)


def begin(atlas: Atlas, window: WindowInput) -> Atlas | None:
    """Start the first map; or a submap of this frame alone where the prior's world is not related to any known one.

    A submap starts at the pose of the frame before, in the prior's own unit: that of another map does not apply.
    Returns None where none starts.
    """
    if not atlas.submaps:
        return with_state(atlas, *start(window.prediction, atlas.camera, atlas.config))
    pose, graph, before = window.T_anchor_views.get(window.frames[0].index), atlas.graph, atlas.state
    is_new = graph.config is not None and before is not None and not atlas.is_frozen
    if not is_new or is_related(atlas.world, window) or pose is None or not np.isfinite(pose).all():
        return None
    last = graph.nodes[-1].pose
    view = jax.tree.map(lambda leaf: leaf[None], as_step_prediction(window.prediction).current)
    first = FirstWindow(view, to_se3(last[None]), no_covariance()[None], unknown_scale()[None])
    alone, config = start(first, atlas.camera, atlas.config)
    if not bool(alone.map.gaussians.valid.any()):
        return None
    map = replace(alone.map, birth=jnp.full_like(alone.map.birth, before.time))
    atlas = _with_world_left(atlas)
    atlas = replace(atlas, graph=replace(graph, active=max(atlas.submaps) + 1), world=place_world(window, last))
    return with_state(atlas, replace(alone, map=map, time=before.time + 1), config)


def _with_world_left(atlas: Atlas) -> Atlas:
    """Note in the active submap where the prior's world lies that the run leaves."""
    left = replace(atlas.active, worlds={**atlas.active.worlds, atlas.world.number: atlas.world})
    return replace(atlas, submaps={**atlas.submaps, atlas.graph.active: left})


def return_to_world(atlas: Atlas, window: WindowInput) -> Atlas:
    """Switch to the world of this frame where the run has been in it before, and to its submap.

    Nothing of the frame before is known there: the step starts at the pose that the prior predicts.
    """
    known = (number for number, submap in atlas.submaps.items() if window.structure in submap.worlds)
    number = None if atlas.state is None or is_related(atlas.world, window) else next(known, None)
    if number is None:
        return atlas
    submap, time = atlas.submaps[number], atlas.state.time
    previous = replace(submap.state.previous, valid=jnp.zeros_like(submap.state.previous.valid))
    atlas = replace(_with_world_left(atlas), graph=replace(atlas.graph, active=number))
    atlas = replace(atlas, world=submap.worlds[window.structure])
    return with_state(atlas, replace(atlas.state, previous=previous, time=time), atlas.config)


@dataclass(frozen=True)
class Found:
    """A frame found in a submap, which may be the active one.

    Args:
        place: as keyframes say it.
        after: state of the submap, result of the step that begins there, and config.
    """

    submap: int
    place: RelocalizedPose
    after: tuple[SlamState, StepInfo, SlamConfig]


def locate(atlas: Atlas, window: WindowInput, in_other_submap: bool = False) -> Found | str:
    """Find a frame in a submap: by its keyframes, and then by a step from there; or return why that fails.

    Args:
        in_other_submap: search the other submap that has the most similar keyframe, with a free ratio of units; else
            the one where the camera is. Before it is in any, that is the saved map.
    """
    graph = atlas.graph
    place, failure = relocalize_frame(graph, window.data[0], in_other_submap)
    if place is None:
        return failure or NO_CANDIDATE
    number, is_known = graph.nodes[place.keyframe].submap, is_related(atlas.world, window)
    world = atlas.world if is_known else place_world(window, place.T_world_camera)
    is_same_unit = number == graph.active and is_known
    prediction, state = step_prediction(world, window), atlas.submaps[number].state
    begun, again = relocalized_start(state, prediction, place, is_same_unit)
    begun, info, config = advance(begun, again, atlas.camera, atlas.config)
    failure = rejection(info, again, place, graph.config.relocalization)
    return failure or Found(number, place, (begun, info, config))


def relocalized_start(
    state: SlamState, prediction: Prediction, place: RelocalizedPose, is_same_unit: bool = True
) -> tuple[SlamState, Prediction]:
    """Return a state and prediction whose step starts at the relocalized pose: this frame is its own previous one.

    Without `is_same_unit` this frame determines the prior's unit: in another map, or where the prior's lengths are no
    longer those of the steps before.

    Raises:
        ValueError: the features of a saved map are not as wide as those of this run.
    """
    widths = state.map.gaussians.features.shape[-1], prediction.current.features.shape[-1]
    if widths[0] != widths[1]:
        raise ValueError(
            f"the features of the saved map have width {widths[0]} and those of this run {widths[1]}: use prior= and "
            "features= that it was mapped with"
        )
    T, scale = to_se3(place.T_world_camera), jnp.exp(jnp.asarray(place.log_scale, jnp.float32))
    placed = move_prediction(prediction, anchor_motion(prediction, T, scale))
    views = placed.T_world_views.wxyz_xyz[jnp.array([1, 1, 2])]
    again = replace(placed, previous=placed.current, T_world_views=jaxlie.SE3(views), is_repeat=jnp.asarray(False))
    covariance, log_scale = (jnp.asarray(x, jnp.float32) for x in (place.covariance, place.log_scale))
    estimate = replace(state.estimate, covariance=covariance)
    if not is_same_unit:
        estimate = replace(estimate, log_scale=log_scale)
    return replace(
        state, previous=transform(T, prediction.current, scale), T_world_previous=T, estimate=estimate
    ), again


def rejection(
    info: StepInfo, prediction: Prediction, place: RelocalizedPose, config: RelocalizationConfig
) -> str | None:
    """Return why the map rejects a relocalized pose (too few inliers, or they move it too far); None if it does not."""
    found, current = info.localization, prediction.current
    depth = np.median(np.asarray(current.points[:, 2])[np.asarray(current.valid)]) * np.exp(place.log_scale)
    agrees = bool(found.is_tracked) and float(found.icp.inlier_fraction) >= config.min_inlier_fraction
    stays = found.step_m <= config.max_step * depth and np.degrees(found.step_rad) <= config.max_step_deg
    return None if agrees and stays else FINE_POSE


def camera_in_world(info: StepInfo) -> Sim3:
    """Similarity from a camera's frame, in the unit of its prediction, to the world."""
    T = to_matrix(np.asarray(info.T_world_camera.wxyz_xyz))
    return Sim3(float(info.localization.scale), T[:3, :3], T[:3, 3])


def join_at(atlas: Atlas, window: WindowInput, event: Event, found: Found) -> Atlas:
    """Join the active submap, with this frame as its last node, and the one where the frame was found.

    The newer one moves, by the similarity of the event or its inverse.
    """
    graph, similarity = atlas.graph, Sim3.from_matrix(event.similarity)
    here, there = graph.active, found.submap
    if here < there:
        similarity = similarity.inverse()
    newer, older, before = max(here, there), min(here, there), nodes_of(graph)
    unit = np.exp(graph.nodes[found.place.keyframe].log_scale)  # its map may be the one that moves
    graph = transform_nodes(graph, [row for row, one in enumerate(graph.nodes) if one.submap == newer], similarity)
    after, min_std, deform = nodes_of(graph), graph.min_std, graph.config.deform
    nodes = tuple(replace(node, submap=older) if node.submap == newer else node for node in graph.nodes)
    factors = [*graph.factors, join_factor(graph, found.place, unit)]
    graph = replace(graph, nodes=nodes, active=older, has_one_unit=False, factors=factors)
    state = deform_state(atlas.state, before, after, min_std, deform)
    moved = move_map(atlas.submaps[there].state.map, before, after, jnp.asarray(min_std, jnp.float32), deform)
    map, config = add_map(state.map, moved, atlas.config)
    state, world = replace(state, map=map), atlas.world
    if here == newer:
        scale = jnp.asarray(similarity.scale, jnp.float32)
        state = replace(state, estimate=rescale_estimate(state.estimate, scale))
        world = anchor_world(world, window, graph.nodes[-1].pose, similarity.scale * event.scale)
    # Where another world of the prior lies in a submap that moves is not known any more.
    both = Submap(state, worlds=atlas.submaps[older].worlds)
    others = {number: submap for number, submap in atlas.submaps.items() if number not in (here, there)}
    return replace(atlas, graph=graph, world=world, config=config, submaps={older: both, **others})


def join_factor(graph: BackEnd, place: RelocalizedPose, unit: float) -> Factor:
    """Build the join factor of two submaps: the last node relative to the keyframe that relocalized it, as now.

    `unit` is a length of that keyframe's inference in the map in which the pose was found.
    """
    a, b = place.keyframe, len(graph.nodes) - 1
    here, there = graph.nodes[a], graph.nodes[b]
    scale = np.exp(here.log_scale)
    information = np.linalg.inv(scale_covariance(place.covariance, 1.0 / unit))
    measured = scale_pose(np.linalg.inv(here.pose) @ there.pose, 1.0 / scale)
    ratio = there.log_scale - here.log_scale
    return Factor(a, b, measured, ratio, np.linalg.cholesky(information).T, is_loop=False)


def set_unjoined_apart(atlas: Atlas, kept: int | None = None) -> Atlas:
    """Make a submap the active one; the others stay as they are, apart.

    Args:
        kept: its number; None: that of most placed frames, or the saved map's.
    """
    if len(atlas.submaps) < 2:
        return atlas
    graph, known = atlas.graph, atlas.graph.database
    if kept is None:
        counts = Counter(node.submap for node in graph.nodes if node.is_placed)
        kept = 0 if graph.first_node else max(sorted(counts), key=lambda one: counts[one])
    is_kept = [node.submap == kept for node in graph.nodes]
    between = {
        name: [one for one in getattr(graph, name) if is_kept[one.a] and is_kept[one.b]]
        for name in ("factors", "verified", "violating", "accepted")
    }
    rows = [row for row, one in enumerate(known.keyframes) if is_kept[one.frame]]
    keyframes = tuple(known.keyframes[row] for row in rows)

    def apart(node: Node) -> Node:
        return replace(node, is_placed=False, covariance=node.covariance if node.is_placed else None)

    nodes = tuple(node if here else apart(node) for node, here in zip(graph.nodes, is_kept, strict=True))
    database = replace(known, keyframes=keyframes, vectors=known.vectors[rows])
    return replace(atlas, graph=replace(graph, nodes=nodes, active=kept, database=database, **between))
