"""The back end of a run: what windows, map and loops measure, the best poses for all of it, and a map that follows.

Nodes are the frames from the first of the map on, in the order of `SlamState.time`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.graph.deform import deform, deform_view
from emgs_jax.graph.measurements import LOOP, WINDOW, Edges, Graph, Nodes
from emgs_jax.graph.optimize import GraphConfig, GraphInfo, optimize
from emgs_jax.loops.agreement import AgreementConfig, agreeing
from emgs_jax.loops.appearance import AppearanceConfig, Database, describe, extend, propose
from emgs_jax.loops.two_views import gap_between, rescaled
from emgs_jax.loops.verification import LoopMeasurement, Neighbour, VerificationConfig, VerifyInfo, verify
from emgs_jax.running.convert import to_se3
from emgs_jax.slam import SlamState

_deform, _deform_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations of what is measured, m, degrees and log-scale.

    Args:
        pair, pair_deg: of the relative pose of two neighbours in a window; those k apart: √k times.
        anchor, anchor_deg: of the pose relative to the anchor, times 1 + the distance to it in metres. Its errors last
            for many windows, so one window counts as less than its own error would say.
        map, map_deg: of a frame placed in the map, relative to the frame of whose Gaussians it was placed by.
        log_scale: of the ratio of two neighbours' scales.
    """

    pair: float
    pair_deg: float
    anchor: float
    anchor_deg: float
    map: float
    map_deg: float
    log_scale: float


@dataclass(frozen=True)
class BackEndConfig:
    """What is measured, how loops are found, and how all is solved.

    Args:
        offsets: earlier frames of a window that its current one is measured to.
        noise: of these measurements.
        appearance: keyframes and candidates.
        verification: of a candidate.
        agreement: of verified loops with each other.
        every: frames between keyframes.
        min_correction, min_correction_deg: a loop that moves its query less says what is so already, and is left out.
        solver: of the graph.
    """

    offsets: tuple[int, ...]
    noise: NoiseConfig
    appearance: AppearanceConfig
    verification: VerificationConfig
    agreement: AgreementConfig
    every: int
    min_correction: float
    min_correction_deg: float
    solver: GraphConfig


@dataclass(frozen=True)
class Look:
    """What the back end takes of a frame, beside its pose.

    Args:
        frame: index in the data set.
        image: RGB, uint8 (h, w, 3).
        points: camera frame, m of its inference, (h, w, 3).
        mask: of these, (h, w).
        T_anchor_views: by frame index, the poses (4, 4) that its inference says; some may not be finite.
    """

    frame: int
    image: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    T_anchor_views: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class Closure:
    """One solution: at which node, the loops that were new, and what the solver says of it."""

    time: int
    loops: tuple[LoopMeasurement, ...]
    info: GraphInfo


@dataclass
class BackEnd:
    """Measurements as far as a run is.

    Args:
        config: all of it.
        intrinsics: of the images.
        min_std: floor of the map's covariances.
        poses: T_world_camera (4, 4) of the nodes, as they are now.
        log_scales: σ of their inferences, likewise.
        online: poses as they were when the frames were placed.
        frames: index in the data set of every node.
        edges: rows of (a, b, Z (4, 4), log-ratio, sqrt_info (7, 7), kind).
        database: keyframes; their `frame` is the node.
        verified: loops that passed every gate of two keyframes.
        contradicted: loops that something speaks against.
        accepted: loops that are edges.
        refusals: why candidates were no loops.
        closures: what was solved.
    """

    config: BackEndConfig
    intrinsics: tuple[float, float, float, float]
    min_std: float
    poses: list[np.ndarray] = field(default_factory=list)
    log_scales: list[float] = field(default_factory=list)
    online: list[np.ndarray] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    edges: list[tuple] = field(default_factory=list)
    database: Database = field(default_factory=Database)
    verified: list[LoopMeasurement] = field(default_factory=list)
    contradicted: list[LoopMeasurement] = field(default_factory=list)
    accepted: list[LoopMeasurement] = field(default_factory=list)
    refusals: Counter = field(default_factory=Counter)
    closures: list[Closure] = field(default_factory=list)

    def add(self, look: Look, pose: np.ndarray, scale: float, origin: int | None) -> None:
        """One node more, with what its window and the map measure.

        Args:
            look: of the frame.
            pose: T_world_camera.
            scale: of its inference.
            origin: node of whose Gaussians it was placed by; None where it was not placed in the map.
        """
        time = len(self.poses)
        self.poses.append(np.asarray(pose, np.float64))
        self.online.append(self.poses[-1])
        self.log_scales.append(float(np.log(scale)))
        self.frames.append(look.frame)
        self.edges += _window_edges(look, time, self)
        if origin is not None and origin < time:
            measured = np.linalg.inv(self.poses[time]) @ self.poses[origin]
            measured[:3, 3] *= np.exp(-self.log_scales[time])
            noise = self.config.noise
            self.edges.append((time, origin, measured, 0.0, _weights(noise.map, noise.map_deg, np.inf), WINDOW))

    def look_for_loops(self, look: Look) -> list[LoopMeasurement]:
        """Describe the last node, and verify what it looks like; returns the loops that are new and agreed upon."""
        time = len(self.poses) - 1
        if time % self.config.every:
            return []
        appearance = self.config.appearance
        keyframe = describe(time, look.image, look.points, look.mask, self.intrinsics, appearance)
        self.database = extend(self.database, keyframe, appearance)
        row = len(self.database.keyframes) - 1
        for candidate in propose(self.database, row, appearance):
            self._verify(row, candidate.row)
        known = {(loop.a, loop.b) for loop in self.accepted}
        agreed = agreeing(
            self.verified,
            self.contradicted,
            dict(enumerate(self.poses)),
            dict(enumerate(self.log_scales)),
            self.config.agreement,
        )
        return [loop for loop, yes in zip(self.verified, agreed, strict=True) if yes and (loop.a, loop.b) not in known]

    def _verify(self, row: int, other: int) -> None:
        keyframes = self.database.keyframes
        candidate = keyframes[other]
        beside = [keyframes[k] for k in (other - 1, other + 1) if 0 <= k < row]
        inverse, scale = np.linalg.inv(self.poses[candidate.frame]), self.log_scales[candidate.frame]
        neighbours = [
            Neighbour(
                one,
                rescaled(inverse @ self.poses[one.frame], np.exp(-scale)),
                self.log_scales[one.frame] - scale,
            )
            for one in beside
        ]
        loop, info = verify(keyframes[row], candidate, neighbours, self.config.verification)
        self._note(loop, info)

    def _note(self, loop: LoopMeasurement | None, info: VerifyInfo) -> None:
        if info.contradicted is not None:
            self.contradicted.append(info.contradicted)
        if loop is None:
            self.refusals[info.refused_by.value] += 1
        else:
            self.verified.append(loop)

    def is_needed(self, loop: LoopMeasurement) -> bool:
        """Whether a loop says something that is not so already."""
        implied = self.poses[loop.a] @ rescaled(loop.Z_a_b, np.exp(self.log_scales[loop.a]))
        distance, turn = gap_between(self.poses[loop.b], implied)
        return distance > self.config.min_correction or turn > self.config.min_correction_deg

    def close(self, state: SlamState, loops: Sequence[LoopMeasurement] = ()) -> SlamState:
        """Solve with `loops` as edges, and move poses and map; if that is refused all stays, and they are no edges."""
        edges = [(loop.a, loop.b, loop.Z_a_b, loop.log_ratio, loop.sqrt_info, LOOP) for loop in loops]
        before = self.nodes()
        after, info = optimize(Graph(before, _stacked([*self.edges, *edges])), self.config.solver)
        self.closures.append(Closure(len(self.poses) - 1, tuple(loops), info))
        if info.reason:
            return state
        self.edges += edges
        self.accepted += loops
        count = len(self.poses)
        self.poses = list(np.asarray(after.T_world.as_matrix(), np.float64)[:count])
        self.log_scales = list(np.asarray(after.log_scale, np.float64)[:count])
        return follow(state, before, after, self.min_std)

    def nodes(self) -> Nodes:
        """All nodes, with free rows up to a power of two: the map's part compiles rarely."""
        count = len(self.poses)
        room = max(64, 1 << (count - 1).bit_length())
        poses = to_se3(np.stack([*self.poses, *[np.eye(4)] * (room - count)]))
        scales = jnp.asarray([*self.log_scales, *[0.0] * (room - count)], jnp.float32)
        return Nodes(poses, scales, jnp.arange(room) < count)


def metric_graph(end: BackEnd) -> Graph:
    """Poses and measurements in the map's scale, without scales of their own: what other solvers read."""
    scaled = [(a, b, rescaled(Z, np.exp(end.log_scales[a])), 0.0, *rest) for a, b, Z, _, *rest in end.edges]
    nodes = end.nodes()
    return Graph(replace(nodes, log_scale=jnp.zeros_like(nodes.log_scale)), _stacked(scaled))


def follow(state: SlamState, before: Nodes, after: Nodes, min_std: float) -> SlamState:
    """The state whose map and last frame conform to other poses."""
    last = state.time - 1
    return replace(
        state,
        map=_deform(state.map, before, after, jnp.asarray(min_std, jnp.float32)),
        previous=_deform_view(state.previous, before, after, last),
        T_world_previous=_moved_pose(state.T_world_previous, before, after, int(last)),
    )


def _moved_pose(T: jaxlie.SE3, before: Nodes, after: Nodes, row: int) -> jaxlie.SE3:
    """The node's new pose; T itself, bit for bit, where the node stays."""
    old, new = before.T_world.wxyz_xyz[row], after.T_world.wxyz_xyz[row]
    return jaxlie.SE3(jnp.where(jnp.all(old == new), T.wxyz_xyz, new))


def _weights(distance: float, turn_deg: float, log_scale: float) -> np.ndarray:
    """(7, 7) square root of the information of independent errors; an infinite one is not measured."""
    return np.diag(1.0 / np.array([distance] * 3 + [np.radians(turn_deg)] * 3 + [log_scale]))


def _window_edges(look: Look, time: int, end: BackEnd) -> list[tuple]:
    """What an inference says of its current frame and earlier ones of its window, and of the anchor."""
    poses, noise = look.T_anchor_views, end.config.noise
    here = poses.get(look.frame)
    if here is None or not np.isfinite(here).all():
        return []
    edges = []
    for offset in end.config.offsets:
        there, row = poses.get(look.frame - offset), time - offset
        if there is None or row < 0 or not np.isfinite(there).all():
            continue
        spread = np.sqrt(offset)
        ratio = end.log_scales[row] - end.log_scales[time]
        weights = _weights(spread * noise.pair, spread * noise.pair_deg, noise.log_scale if offset == 1 else np.inf)
        edges.append((time, row, np.linalg.inv(here) @ there, ratio, weights, WINDOW))
    anchor = poses.get(0)
    if end.frames[0] == 0 and anchor is not None and look.frame > max(end.config.offsets):
        measured = np.linalg.inv(here) @ anchor
        reach = 1.0 + np.linalg.norm(measured[:3, 3])
        weights = _weights(reach * noise.anchor, reach * noise.anchor_deg, np.inf)
        edges.append((time, 0, measured, 0.0, weights, WINDOW))
    return edges


def _stacked(edges: Sequence[tuple]) -> Edges:
    a, b, Z, ratios, weights, kinds = zip(*edges, strict=True)
    return Edges(
        a=jnp.asarray(a, jnp.int32),
        b=jnp.asarray(b, jnp.int32),
        Z_a_b=to_se3(np.stack(Z)),
        log_ratio=jnp.asarray(ratios, jnp.float32),
        sqrt_info=jnp.asarray(np.stack(weights), jnp.float32),
        kind=jnp.asarray(kinds, jnp.int32),
        valid=jnp.ones(len(edges), bool),
    )


def counts(end: BackEnd) -> dict[str, Any]:
    """What became of the candidates, for metrics.json."""
    refused = {f"loops/refused_{gate}": count for gate, count in sorted(end.refusals.items())}
    solved = [closure for closure in end.closures if closure.loops]
    return {
        "loops/verified": len(end.verified),
        "loops/contradicted": len(end.contradicted),
        "loops/accepted": len(end.accepted),
        "loops/closures": sum(not closure.info.reason for closure in solved),
        "loops/closures_refused": sum(bool(closure.info.reason) for closure in solved),
    } | refused
