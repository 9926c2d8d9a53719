"""The back end: a pose graph of keyframes and loop closures; optimized poses deform the map.

Nodes are the frames from the first one of the map on, in the order of `SlamState.time`.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from emgs_jax.back_end.factors import (
    Factor,
    FrameData,
    NoiseConfig,
    is_repeated,
    map_factor,
    sequential_factor,
    window_factor,
    with_disagreement,
)
from emgs_jax.geometry import Sim3, scale_covariance
from emgs_jax.loop_closure.consistency import ConsistencyConfig
from emgs_jax.loop_closure.place_recognition import Database, PlaceRecognitionConfig
from emgs_jax.loop_closure.prior_query import PriorQueryConfig
from emgs_jax.loop_closure.relocalization import RelocalizationConfig
from emgs_jax.loop_closure.verification import LoopMeasurement, VerificationConfig
from emgs_jax.ops.ranges import number
from emgs_jax.pose_graph.deform import DeformConfig
from emgs_jax.pose_graph.optimize import PoseGraphConfig, PoseGraphInfo


@dataclass(frozen=True)
class BackEndConfig:
    """Settings of the back end: noise of factors, place recognition, loop closures, optimization and relocalization.

    Args:
        every: frames between keyframes.
        min_violation: χ² of a measurement at the current poses beyond which it violates them. Only such a loop starts
            a closure and a query of the prior, and such a window factor is left out.
        min_frames: between two closures.
        deform: deformation of the map with the optimized poses.
    """

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    place_recognition: PlaceRecognitionConfig = field(default_factory=PlaceRecognitionConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    prior_query: PriorQueryConfig = field(default_factory=PriorQueryConfig)
    every: int = number(1, low=1, high=1000)
    min_violation: float = number(18.5, low=0, high=math.inf)  # χ²₇ at 99 %
    min_frames: int = number(10, low=0)
    solver: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    deform: DeformConfig = field(default_factory=DeformConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)


@dataclass(frozen=True)
class Node:
    """A frame in the pose graph.

    Args:
        pose: current T_world_camera (4, 4).
        online: the pose as first estimated, in the unit of `pose`.
        log_scale: σ of its inference.
        frame: index in the data set.
        submap: disconnected submap that holds it; the relative pose of two submaps is not known.
        is_placed: True in the map: the frame is neither degraded nor lost.
        covariance: (6, 6) of `online`, see `FrameRecord`; None without one, or in a saved map, which counts as exact.
        origin: node whose Gaussians it was registered to; None if it was not registered.
        depth_noise: difference of its points from the map, as a fraction of their depth; None if it was not registered.
        predicted: T_anchor_camera (4, 4) as the prior predicted it, in its first world; None without one, or in a saved
            map.
    """

    pose: np.ndarray
    online: np.ndarray
    log_scale: float
    frame: int
    submap: int = 0
    is_placed: bool = True
    covariance: np.ndarray | None = None
    origin: int | None = None
    depth_noise: float | None = None
    predicted: np.ndarray | None = None


@dataclass(frozen=True)
class Closure:
    """One pose-graph optimization: its node, the new loops, and the solver's result."""

    time: int
    loops: tuple[LoopMeasurement, ...]
    info: PoseGraphInfo


class Refusal(NamedTuple):
    """A rejected loop candidate: two nodes, the gate that rejected it, and the value that this gate tested."""

    a: int
    b: int
    gate: str
    measured: float


@dataclass(frozen=True)
class BackEnd:
    """State of the back end: nodes, factors and loops of the pose graph. Immutable: functions return a new one.

    Args:
        config: None: nodes only; poses stay as first estimated.
        min_std: floor of the map's covariances.
        database: keyframes; their `frame` is the node.
        verified: loops that passed every gate of two keyframes.
        violating: loops with a free-space violation.
        accepted: loops that are factors.
        refusals: candidates that were rejected, and why.
        queries: loops, by their nodes, for which the prior was queried, and the outcome, see `prior_queries`.
        closures: optimizations so far.
        first_node: this run's first frame; earlier nodes are of the run that saved the map.
        connected_since: node since which consecutive frames are connected; before it the camera was lost.
        active: submap of the next node, where the camera is; None until it is relocalized in the saved map, submap 0.
        has_one_unit: the inferences of all nodes share one unit, as far as the prior's do.
    """

    config: BackEndConfig | None
    intrinsics: tuple[float, float, float, float]
    min_std: float
    nodes: Sequence[Node] = ()
    factors: Sequence[Factor] = field(default_factory=list)
    database: Database = field(default_factory=Database)
    verified: Sequence[LoopMeasurement] = field(default_factory=list)
    violating: Sequence[LoopMeasurement] = field(default_factory=list)
    accepted: Sequence[LoopMeasurement] = field(default_factory=list)
    refusals: Sequence[Refusal] = field(default_factory=list)
    queries: Mapping[tuple[int, int], str] = field(default_factory=dict)
    closures: Sequence[Closure] = field(default_factory=list)
    first_node: int = 0
    connected_since: int = 0
    active: int | None = 0
    has_one_unit: bool = True

    @property
    def poses(self) -> list[np.ndarray]:
        """Current T_world_camera (4, 4) of the nodes."""
        return [node.pose for node in self.nodes]

    @property
    def log_scales(self) -> list[float]:
        """σ of the nodes' inferences."""
        return [node.log_scale for node in self.nodes]


def add_node(
    end: BackEnd, frame: FrameData, pose: np.ndarray, scale: float, origin: int | None, is_placed: bool = True
) -> BackEnd:
    """Add a node with the pose of its frame, and its sequential and map factors; and a window factor if it comes back.

    Args:
        scale: of its inference.
        origin: node whose Gaussians it was registered to; None if it was not registered.
        is_placed: the map holds it: it was registered to the map, or the map was made from it.
    """
    time, pose = len(end.nodes), np.asarray(pose, np.float64)
    known = {"covariance": frame.covariance, "origin": origin, "depth_noise": frame.depth_noise}
    known["predicted"] = frame.predicted
    node = Node(pose, pose, float(np.log(scale)), frame.index, end.active, is_placed, **known)
    end = replace(end, nodes=(*end.nodes, node))
    if end.config is None:
        return end
    known, noise = (frame, end.poses, end.log_scales), end.config.noise
    is_connected = partial(_is_connected, end)
    factors = [sequential_factor(*known, is_connected, noise)]
    if origin is not None and origin < time:
        factors.append(map_factor(*known, origin, noise))
        if time - origin > (visit := float(end.config.deform.max_gap)):
            factors.append(window_factor(*known, is_connected, noise, (visit, end.config.min_violation)))
    factors, before = [*filter(None, factors)], end.nodes[time - 1]
    if time and is_repeated(frame, before.frame, before.predicted):
        factors = [_with_disagreement(end, factor, frame.depth) for factor in factors]
    return replace(end, factors=[*end.factors, *factors])


def _with_disagreement(end: BackEnd, factor: Factor, depth: float) -> Factor:
    """Add the difference of map and prior to a new factor, see `with_disagreement`, if the prior knows both nodes.

    Args:
        depth: median depth that its first node sees, in units of its inference.
    """
    a, b = end.nodes[factor.a], end.nodes[factor.b]
    if a.predicted is None or b.predicted is None:
        return factor
    estimated, predicted = np.linalg.inv(a.pose) @ b.pose, np.linalg.inv(a.predicted) @ b.predicted
    return with_disagreement(factor, estimated, predicted, (depth, depth * math.exp(a.log_scale)))


def _is_connected(end: BackEnd, row: int) -> bool:
    """Test whether a node is in the map or has a factor other than loops; False before relocalization."""
    has_factor = any(factor.a == row and not factor.is_loop for factor in end.factors)
    return row >= end.connected_since and (end.nodes[row].is_placed or has_factor)


def transform_nodes(end: BackEnd, rows: Collection[int], similarity: Sim3) -> BackEnd:
    """Map poses, covariances and scales of some nodes to another world."""

    def moved(node: Node) -> Node:
        pose, online = map(similarity.apply_to_poses, (node.pose, node.online))
        log_scale, covariance = node.log_scale + float(np.log(similarity.scale)), node.covariance
        covariance = None if covariance is None else scale_covariance(covariance, similarity.scale)
        return replace(node, pose=pose, online=online, log_scale=log_scale, covariance=covariance)

    return replace(end, nodes=tuple(moved(node) if row in rows else node for row, node in enumerate(end.nodes)))
