"""The maps of a run, whose relative poses may be unknown, and how to join two of them.

A prior that has lost the first view may continue in a world of its own. There a new map starts, and the previous one
becomes inactive. If a frame fits an inactive map, the similarity between its two poses joins both submaps: poses,
scales and Gaussians of the newer one move. A saved map is an inactive submap until a frame is relocalized in it.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.back_end.factors import Factor
from emgs_jax.back_end.optimization import deform_state, move_map, nodes_of
from emgs_jax.back_end.saved_map import SavedMap
from emgs_jax.back_end.state import BackEnd, Node, transform_nodes
from emgs_jax.gaussian_map import grow
from emgs_jax.geometry import Sim3, scale_covariance, scale_pose
from emgs_jax.loop_closure.place_recognition import keyframes_but
from emgs_jax.loop_closure.relocalization import RelocalizedPose
from emgs_jax.mapping.capacity import add_map
from emgs_jax.motion import no_looks
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.registration.pose_estimate import exact_estimate, rescale_estimate
from emgs_jax.slam import SlamConfig, SlamState


@dataclass(frozen=True)
class World:
    """A world of the prior, and its place in the submap that is mapped in it.

    Args:
        number: `WindowInput.world`; 0: that of the first frame.
        T_world_prior: its pose (4, 4); None: that of the first frame, which predictions already include.
        T_world_anchor: (4, 4), the frame about which its lengths are scaled; None likewise.
        motion: of this world since relocalization; None: the identity.
    """

    number: int = 0
    T_world_prior: np.ndarray | None = None
    T_world_anchor: np.ndarray | None = None
    motion: jaxlie.SE3 | None = None


@dataclass(frozen=True)
class Submap:
    """A map whose pose relative to other maps is unknown.

    Args:
        state: its SLAM state; before a frame is relocalized in a saved map, only map and depth noise mean anything.
        is_frozen: True in localization mode: the map and its pose graph stay as they are.
        worlds: worlds of the prior that lie in it and that the run has left, by number.
    """

    state: SlamState
    is_frozen: bool = False
    worlds: Mapping[int, World] = field(default_factory=dict)


def unvisited(saved: SavedMap, camera: Camera, config: SlamConfig) -> Submap:
    """Make the submap of a saved map, before any frame of this camera is relocalized in it."""
    view, time = downscale(camera, config.observation.thin), jnp.asarray(len(saved.back_end.nodes), jnp.int32)
    size, width = view.width * view.height, saved.map.gaussians.features.shape[-1]
    estimate = replace(exact_estimate(), depth_noise=jnp.asarray(saved.depth_noise, jnp.float32))
    arrays = (jnp.zeros((size, columns)) for columns in (3, 3, 3, width))
    nothing = Observation(*arrays, jnp.zeros(size), jnp.zeros(size, bool))
    known = nothing, jaxlie.SE3.identity(), estimate, time, no_looks(nothing, config.motion)
    return Submap(SlamState(saved.map, *known), saved.is_frozen)


@dataclass(frozen=True)
class Atlas:
    """Everything that the mapping knows after an input. Immutable: each input makes a new one.

    Args:
        config: its capacities grow with the maps.
        submaps: by number.
        graph: poses of all frames, and the number of the active submap, where the camera is.
        world: the prior's current world.
        num_lost: frames since the last one that was placed in a map.
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
    """Set the state of the active submap and the config with its capacities; a frozen map stays."""
    number, before = atlas.graph.active, atlas.active or Submap(state)
    if before.is_frozen:
        map, capacity = before.state.map, config.submap.map_capacity
        state = replace(state, map=grow(map, capacity) if capacity > map.weight.shape[0] else map)
    return replace(atlas, submaps={**atlas.submaps, number: replace(before, state=state)}, config=config)


def join_at(atlas: Atlas, similarity: Sim3, place: RelocalizedPose) -> Atlas:
    """Join the active submap, whose last node is this frame, and the submap in which the frame was relocalized.

    The newer one moves and gets the number of the older one, which is then active.

    Args:
        similarity: from the active submap to the other.
        place: pose of the frame in the other, by a keyframe there.
    """
    graph = atlas.graph
    here, there = graph.active, graph.nodes[place.keyframe].submap
    newer, older, before = max(here, there), min(here, there), nodes_of(graph)
    motion = similarity if here == newer else similarity.inverse()
    unit = np.exp(graph.nodes[place.keyframe].log_scale)  # its map may be the newer one, which moves
    graph = transform_nodes(graph, [row for row, one in enumerate(graph.nodes) if one.submap == newer], motion)
    after, min_std, deform = nodes_of(graph), graph.min_std, graph.config.deform
    nodes = tuple(replace(node, submap=older) if node.submap == newer else node for node in graph.nodes)
    factors = [*graph.factors, join_factor(graph, place, unit)]
    graph = replace(graph, nodes=nodes, active=older, has_one_unit=False, factors=factors)
    state = deform_state(atlas.state, before, after, min_std, deform)
    moved = move_map(atlas.submaps[there].state.map, before, after, jnp.asarray(min_std, jnp.float32), deform)
    map, config = add_map(state.map, moved, atlas.config)
    state = replace(state, map=map)
    if here == newer:
        state = replace(state, estimate=rescale_estimate(state.estimate, jnp.asarray(motion.scale, jnp.float32)))
    # The places of other worlds in a submap that moves are no longer known.
    both = Submap(state, worlds=atlas.submaps[older].worlds)
    others = {number: submap for number, submap in atlas.submaps.items() if number not in (here, there)}
    return replace(atlas, graph=graph, config=config, submaps={older: both, **others})


def join_factor(graph: BackEnd, place: RelocalizedPose, unit: float) -> Factor:
    """Build the join factor of two submaps: the last node's current pose relative to the keyframe that relocalized it.

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
    """Make a submap the active one; the others stay apart.

    Args:
        kept: its number; None: the one with most placed frames, or the saved map.
    """
    if len(atlas.submaps) < 2:
        return atlas
    graph = atlas.graph
    if kept is None:
        counts = Counter(node.submap for node in graph.nodes if node.is_placed)
        kept = 0 if graph.first_node else max(sorted(counts), key=lambda one: counts[one])
    is_kept = [node.submap == kept for node in graph.nodes]
    between = {
        name: [one for one in getattr(graph, name) if is_kept[one.a] and is_kept[one.b]]
        for name in ("factors", "verified", "violating", "accepted")
    }

    def apart(node: Node) -> Node:
        return replace(node, is_placed=False, covariance=node.covariance if node.is_placed else None)

    nodes = tuple(node if here else apart(node) for node, here in zip(graph.nodes, is_kept, strict=True))
    database = keyframes_but(graph.database, {row for row, here in enumerate(is_kept) if not here})
    return replace(atlas, graph=replace(graph, nodes=nodes, active=kept, database=database, **between))
