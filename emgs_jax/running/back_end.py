"""The back end of a run: where frames were placed, what loops say, the best poses for both, and a map that follows.

Nodes are the frames from the first of the map on, in the order of `SlamState.time`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.graph.deform import DeformConfig
from emgs_jax.graph.measurements import LOOP, ODOMETRY, Graph, Nodes
from emgs_jax.graph.optimize import GraphConfig, GraphInfo, optimize
from emgs_jax.graph.problem import bucket
from emgs_jax.loops.agreement import AgreementConfig, agreeing
from emgs_jax.loops.appearance import AppearanceConfig, Database, Keyframe, describe, extend, nearest, propose
from emgs_jax.loops.location import NO_CANDIDATE, Location, LocationConfig, Places, locate
from emgs_jax.loops.revisit import RevisitConfig
from emgs_jax.loops.two_views import rescaled
from emgs_jax.loops.verification import LoopMeasurement, VerificationConfig, VerifyInfo, neighbours_of, verify
from emgs_jax.ops.ranges import number
from emgs_jax.registration.belief import rescaled_belief
from emgs_jax.running.convert import to_se3
from emgs_jax.running.following import follow
from emgs_jax.running.measuring import Edge, Look, NoiseConfig, chain_edge, loop_edge, map_edge, stacked
from emgs_jax.slam import SlamState


@dataclass(frozen=True)
class BackEndConfig:
    """Settings of the back end: noise of factors, place recognition, loop closures, optimization and relocalization.

    Args:
        noise: of the factors that a frame's pose becomes.
        appearance: keyframes and candidates.
        verification: of a candidate.
        agreement: spatial consistency of verified loops.
        revisit: second measurement of loops by the prior.
        every: frames between keyframes.
        max_known: χ² of a loop at the current poses, up to which they agree with it: it starts no closure by itself,
            and the prior is not asked for it.
        min_frames: between two closures.
        solver: of the pose graph.
        deform: of the map, to follow the optimized poses.
        location: relocalization of a lost camera.
    """

    noise: NoiseConfig
    appearance: AppearanceConfig
    verification: VerificationConfig
    agreement: AgreementConfig
    revisit: RevisitConfig
    every: int = number(low=1, high=1000)
    max_known: float = number(low=0, high=math.inf)
    min_frames: int = number(low=0)
    solver: GraphConfig
    deform: DeformConfig
    location: LocationConfig


@dataclass(frozen=True)
class Closure:
    """One pose-graph optimization: its node, the new loops, and the solver's result."""

    time: int
    loops: tuple[LoopMeasurement, ...]
    info: GraphInfo


class Refusal(NamedTuple):
    """A candidate that was no loop: two nodes, the gate that it did not pass, and what that gate measured."""

    a: int
    b: int
    gate: str
    measured: float


@dataclass
class BackEnd:
    """State of the back end: nodes, factors and loops of the pose graph so far.

    Args:
        config: all settings.
        intrinsics: of the images.
        min_std: floor of the map's covariances.
        poses: current T_world_camera (4, 4) of the nodes.
        log_scales: σ of their inferences, likewise.
        online: poses as first estimated, in the unit of `poses`.
        frames: index in the data set of every node.
        is_placed: whether the map holds each of them: those that are neither degraded nor lost.
        segments: of each of them; the relative pose of two segments is not known.
        edges: factors.
        database: keyframes; their `frame` is the node.
        verified: loops that passed every gate of two keyframes.
        contradicted: loops with a free-space violation.
        accepted: loops that are factors.
        refusals: candidates that were rejected, and why.
        asked: loops, by their nodes, that the prior was to measure once more, and the outcome, see `revisiting`.
        closures: optimizations so far.
        first: node of this run's first frame; those before are of the run that its map was saved by.
        since: node since which consecutive frames are connected; before it the camera was lost.
        segment: of the next node.
        has_one_unit: the inferences of all nodes have one unit, as far as the prior has.
    """

    config: BackEndConfig
    intrinsics: tuple[float, float, float, float]
    min_std: float
    poses: list[np.ndarray] = field(default_factory=list)
    log_scales: list[float] = field(default_factory=list)
    online: list[np.ndarray] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    is_placed: list[bool] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    database: Database = field(default_factory=Database)
    verified: list[LoopMeasurement] = field(default_factory=list)
    contradicted: list[LoopMeasurement] = field(default_factory=list)
    accepted: list[LoopMeasurement] = field(default_factory=list)
    refusals: list[Refusal] = field(default_factory=list)
    asked: dict[tuple[int, int], str] = field(default_factory=dict)
    closures: list[Closure] = field(default_factory=list)
    first: int = 0
    since: int = 0
    segment: int = 0
    has_one_unit: bool = True

    def add(self, look: Look, pose: np.ndarray, scale: float, origin: int | None, is_placed: bool = True) -> None:
        """Add a node with the pose of its frame.

        Args:
            look: of the frame.
            pose: T_world_camera.
            scale: of its inference.
            origin: node whose Gaussians it was registered to; None where it was not registered to the map.
            is_placed: the map holds it: it was registered to it, or the map was made from it.
        """
        time = len(self.poses)
        self.poses.append(np.asarray(pose, np.float64))
        self.online.append(self.poses[-1])
        self.log_scales.append(float(np.log(scale)))
        self.frames.append(look.frame)
        self.is_placed.append(is_placed)
        self.segments.append(self.segment)
        chain = chain_edge(look, self.poses, self.log_scales, self._has_place, self.config.noise)
        if chain is not None:
            self.edges.append(chain)
        if origin is not None and origin < time:
            self.edges.append(map_edge(look, self.poses, self.log_scales, origin, self.config.noise))

    def _has_place(self, row: int) -> bool:
        """Test whether a node is in the map or has an odometry factor; False for nodes before the camera was found."""
        is_led = self.is_placed[row] or any(edge.a == row and edge.kind == ODOMETRY for edge in self.edges)
        return row >= self.since and is_led

    def look_for_loops(self, look: Look) -> list[LoopMeasurement]:
        """Describe the last node, and verify what it looks like; returns the new loops that are agreed upon."""
        time, appearance = len(self.poses) - 1, self.config.appearance
        if time % self.config.every:
            return []
        keyframe = self._described(time, look)
        self.database = extend(self.database, keyframe, appearance)
        row = len(self.database.keyframes) - 1
        for candidate in propose(self.database, row, appearance):
            if self._segment_of(candidate.row) == self.segment:
                self._verify(row, candidate.row)
        return self.recent()

    def recent(self) -> list[LoopMeasurement]:
        """Loops of the last queries that are agreed upon and no edges yet."""
        return self.new(self.agreed(since=len(self.poses) - 1 - self.config.agreement.max_query_gap))

    def _described(self, time: int, look: Look) -> Keyframe:
        return describe(time, look.image, look.points, look.mask, self.intrinsics, self.config.appearance)

    def locate(self, look: Look, elsewhere: bool = False) -> tuple[Location | None, str | None]:
        """Relocalize a frame among its segment's keyframes that are in the map; else return why that fails.

        Args:
            look: of a frame that is no node yet, or is no keyframe.
            elsewhere: search the other segment that has the most similar keyframe, whatever the ratio of the units.
        """
        query = self._described(len(self.poses), look)
        segment = self._most_alike(query) if elsewhere else self.segment
        if segment is None:
            return None, NO_CANDIDATE
        is_there = [placed and one == segment for placed, one in zip(self.is_placed, self.segments, strict=True)]
        places = Places(self.database, self.poses, self.log_scales, is_there)
        config = self.config
        return locate(query, places, config.appearance, self._verification(elsewhere), config.location)

    def _most_alike(self, query: Keyframe) -> int | None:
        """The other segment with the placed keyframe that looks most like a query."""
        keyframes = self.database.keyframes
        others = [row for row in range(len(keyframes)) if self._segment_of(row) != self.segment]
        others = [row for row in others if self.is_placed[keyframes[row].frame]]
        found = nearest(self.database, query, others, 1, self.config.appearance)
        return self._segment_of(found[0].row) if found else None

    def _segment_of(self, row: int) -> int:
        """Of a keyframe."""
        return self.segments[self.database.keyframes[row].frame]

    def _verification(self, is_free: bool) -> VerificationConfig:
        """Of two keyframes; with the ratio of their units free where it must be."""
        config = self.config.verification
        if self.has_one_unit and not is_free:
            return config
        return replace(config, alignment=replace(config.alignment, scale_std=math.inf))

    def agreed(self, since: int = 0) -> list[LoopMeasurement]:
        """Return the verified loops of queries from `since` on that are spatially consistent with others."""
        recent = [loop for loop in self.verified if loop.b >= since]
        poses, log_scales = (dict(enumerate(values)) for values in (self.poses, self.log_scales))
        yes = agreeing(recent, self.contradicted, poses, log_scales, self.config.agreement)
        return [loop for loop, ok in zip(recent, yes, strict=True) if ok]

    def new(self, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
        """Select the loops that are not in the pose graph yet."""
        known = {(loop.a, loop.b) for loop in self.accepted}
        return [loop for loop in loops if (loop.a, loop.b) not in known]

    def retract(self, agreed: Sequence[LoopMeasurement]) -> int:
        """Remove the factors of accepted loops not among `agreed`, all consistent ones; return their number."""
        good = {(loop.a, loop.b) for loop in agreed}
        before = len(self.accepted)
        self.accepted = [loop for loop in self.accepted if (loop.a, loop.b) in good]
        self.edges = [edge for edge in self.edges if edge.kind != LOOP or (edge.a, edge.b) in good]
        return before - len(self.accepted)

    def _verify(self, row: int, other: int) -> None:
        keyframes = self.database.keyframes
        candidate = keyframes[other]
        beside = [keyframes[k] for k in (other - 1, other + 1) if 0 <= k < row and self._segment_of(k) == self.segment]
        neighbours = neighbours_of(candidate, beside, self.poses, self.log_scales)
        loop, info = verify(keyframes[row], candidate, neighbours, self._verification(is_free=False))
        self._note((candidate.frame, keyframes[row].frame), loop, info)

    def _note(self, nodes: tuple[int, int], loop: LoopMeasurement | None, info: VerifyInfo) -> None:
        if info.contradicted is not None:
            self.contradicted.append(info.contradicted)
        if loop is None:
            self.refusals.append(Refusal(*nodes, info.refused_by.value, info.measured))
        else:
            self.verified.append(loop)

    def wants_to_close(self, loops: Sequence[LoopMeasurement]) -> bool:
        """Test whether a closure is due: a loop violates the current poses, and the last closure is long enough ago."""
        last = self.closures[-1].time if self.closures else -self.config.min_frames
        is_due = len(self.poses) - 1 - last >= self.config.min_frames
        return is_due and bool(self.news(loops))

    def news(self, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
        """Select the loops that the current poses violate: χ² above `max_known`."""
        return [loop for loop in loops if self.misfit(loop) > self.config.max_known]

    def misfit(self, loop: LoopMeasurement) -> float:
        """χ² of a loop at the poses and scales as they are."""
        scale, other = self.log_scales[loop.a], self.log_scales[loop.b]
        now = rescaled(np.linalg.inv(self.poses[loop.a]) @ self.poses[loop.b], np.exp(-scale))
        error = np.linalg.inv(loop.Z_a_b) @ now
        turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
        return float(np.sum((loop.sqrt_info @ [*error[:3, 3], *turn, other - scale - loop.log_ratio]) ** 2))

    def close(self, state: SlamState, loops: Sequence[LoopMeasurement] = ()) -> SlamState:
        """Solve with `loops` as edges, and move poses and map; if that is refused all stays, and they are no edges."""
        edges = [*self.edges, *map(loop_edge, loops)]
        before, solver = self.nodes(self.segment), self.config.solver
        if not self.has_one_unit:  # the scales are not all about 1
            solver = replace(solver, scale_std=jnp.asarray(math.inf))
        after, info = optimize(Graph(before, stacked(edges)), solver)
        self.closures.append(Closure(len(self.poses) - 1, tuple(loops), info))
        if info.reason:
            return state
        self.edges = edges
        self.accepted += loops
        count = len(self.poses)
        self.poses = list(np.asarray(after.T_world.as_matrix(), np.float64)[:count])
        self.log_scales = list(np.asarray(after.log_scale, np.float64)[:count])
        change = jnp.mean(after.log_scale - before.log_scale, where=before.valid)
        state = replace(state, belief=rescaled_belief(state.belief, jnp.exp(change)))
        return follow(state, before, after, self.min_std, self.config.deform)

    def nodes(self, segment: int | None = None) -> Nodes:
        """All nodes, or those of a segment, with free rows up to a power of two: the map's part compiles rarely."""
        count = len(self.poses)
        room = bucket(count)
        poses = to_se3(np.stack([*self.poses, *[np.eye(4)] * (room - count)]))
        scales = jnp.asarray([*self.log_scales, *[0.0] * (room - count)], jnp.float32)
        is_asked = [segment in (None, one) for one in self.segments]
        return Nodes(poses, scales, jnp.asarray(is_asked + [False] * (room - count)))
