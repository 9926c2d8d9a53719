"""The back end: a pose graph of keyframes and loop closures; optimized poses deform the map.

Nodes are the frames from the first of the map on, in the order of `SlamState.time`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.loop_closure.consistency import ConsistencyConfig, spatially_consistent
from emgs_jax.loop_closure.place_recognition import (
    Database,
    Keyframe,
    PlaceRecognitionConfig,
    add_keyframe,
    make_keyframe,
    most_similar,
    propose_candidates,
)
from emgs_jax.loop_closure.prior_query import PriorQueryConfig
from emgs_jax.loop_closure.relocalization import (
    NO_CANDIDATE,
    PosedKeyframes,
    RelocalizationConfig,
    RelocalizedPose,
    relocalize,
)
from emgs_jax.loop_closure.two_view_refinement import rescaled
from emgs_jax.loop_closure.verification import LoopMeasurement, VerificationConfig, VerifyInfo, neighbours_of, verify
from emgs_jax.ops.ranges import number
from emgs_jax.pose_graph.deform import DeformConfig
from emgs_jax.pose_graph.factors import LOOP, ODOMETRY, Nodes, PoseGraph
from emgs_jax.pose_graph.optimize import PoseGraphConfig, PoseGraphInfo, optimize
from emgs_jax.pose_graph.problem import bucket
from emgs_jax.registration.pose_estimate import rescale_estimate
from emgs_jax.running.convert import to_se3
from emgs_jax.running.deformation import deform_state
from emgs_jax.running.factors import (
    Factor,
    FrameData,
    NoiseConfig,
    loop_factor,
    map_factor,
    sequential_factor,
    stack_factors,
)
from emgs_jax.slam import SlamState


@dataclass(frozen=True)
class BackEndConfig:
    """Settings of the back end: noise of factors, place recognition, loop closures, optimization and relocalization.

    Args:
        noise: of sequential and map factors.
        place_recognition: keyframes, and candidates by their appearance.
        verification: of a candidate.
        consistency: spatial consistency of verified loops.
        prior_query: second measurement of loops by the prior.
        every: frames between keyframes.
        min_violation: χ² of a loop at the current poses beyond which it violates them: only such a loop starts a
            closure, and only for such a loop the prior is queried.
        min_frames: between two closures.
        solver: of the pose graph.
        deform: of the map, to follow the optimized poses.
        relocalization: of a lost camera.
    """

    noise: NoiseConfig
    place_recognition: PlaceRecognitionConfig
    verification: VerificationConfig
    consistency: ConsistencyConfig
    prior_query: PriorQueryConfig
    every: int = number(low=1, high=1000)
    min_violation: float = number(low=0, high=math.inf)
    min_frames: int = number(low=0)
    solver: PoseGraphConfig
    deform: DeformConfig
    relocalization: RelocalizationConfig


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
        is_placed: True for nodes in the map: those that are neither degraded nor lost.
        submap_ids: disconnected submap of every node; the relative pose of two submaps is not known.
        factors: of the pose graph.
        database: keyframes; their `frame` is the node.
        verified: loops that passed every gate of two keyframes.
        violating: loops with a free-space violation.
        accepted: loops that are factors.
        refusals: candidates that were rejected, and why.
        queries: loops, by their nodes, for which the prior was queried, and the outcome, see `prior_queries`.
        closures: optimizations so far.
        first_node: of this run's first frame; those before are of the run that saved the map.
        connected_since: node since which consecutive frames are connected; before it the camera was lost.
        submap_id: of the next node.
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
    submap_ids: list[int] = field(default_factory=list)
    factors: list[Factor] = field(default_factory=list)
    database: Database = field(default_factory=Database)
    verified: list[LoopMeasurement] = field(default_factory=list)
    violating: list[LoopMeasurement] = field(default_factory=list)
    accepted: list[LoopMeasurement] = field(default_factory=list)
    refusals: list[Refusal] = field(default_factory=list)
    queries: dict[tuple[int, int], str] = field(default_factory=dict)
    closures: list[Closure] = field(default_factory=list)
    first_node: int = 0
    connected_since: int = 0
    submap_id: int = 0
    has_one_unit: bool = True

    def add_node(
        self, frame: FrameData, pose: np.ndarray, scale: float, origin: int | None, is_placed: bool = True
    ) -> None:
        """Add a node with the pose of its frame.

        Args:
            frame: its data.
            pose: T_world_camera.
            scale: of its inference.
            origin: node whose Gaussians it was registered to; None where it was not registered to the map.
            is_placed: the map holds it: it was registered to it, or the map was made from it.
        """
        time = len(self.poses)
        self.poses.append(np.asarray(pose, np.float64))
        self.online.append(self.poses[-1])
        self.log_scales.append(float(np.log(scale)))
        self.frames.append(frame.index)
        self.is_placed.append(is_placed)
        self.submap_ids.append(self.submap_id)
        chain = sequential_factor(frame, self.poses, self.log_scales, self._is_connected, self.config.noise)
        if chain is not None:
            self.factors.append(chain)
        if origin is not None and origin < time:
            self.factors.append(map_factor(frame, self.poses, self.log_scales, origin, self.config.noise))

    def _is_connected(self, row: int) -> bool:
        """Test whether a node is in the map or has an odometry factor; False for nodes before the camera was found."""
        has_factor = any(factor.a == row and factor.kind == ODOMETRY for factor in self.factors)
        return row >= self.connected_since and (self.is_placed[row] or has_factor)

    def detect_loops(self, frame: FrameData) -> list[LoopMeasurement]:
        """Add the last node as a keyframe and verify its candidates; return new loops that are spatially consistent."""
        time, config = len(self.poses) - 1, self.config.place_recognition
        if time % self.config.every:
            return []
        keyframe = self._keyframe(time, frame)
        self.database = add_keyframe(self.database, keyframe, config)
        row = len(self.database.keyframes) - 1
        for candidate in propose_candidates(self.database, row, config):
            if self._submap_id_of(candidate.row) == self.submap_id:
                self._verify(row, candidate.row)
        return self.recent_loops()

    def recent_loops(self) -> list[LoopMeasurement]:
        """Select spatially consistent loops of the last queries that are not in the pose graph yet."""
        return self.not_in_graph(self.consistent(since=len(self.poses) - 1 - self.config.consistency.max_query_gap))

    def _keyframe(self, time: int, frame: FrameData) -> Keyframe:
        return make_keyframe(
            time, frame.image, frame.points, frame.mask, self.intrinsics, self.config.place_recognition
        )

    def relocalize(self, frame: FrameData, in_other_submap: bool = False) -> tuple[RelocalizedPose | None, str | None]:
        """Relocalize a frame by keyframes of its submap that are in the map; else return why that fails.

        Args:
            frame: of a frame that is no node yet, or is no keyframe.
            in_other_submap: search the other submap that has the most similar keyframe, with a free ratio of units.
        """
        query = self._keyframe(len(self.poses), frame)
        submap_id = self._most_similar_submap(query) if in_other_submap else self.submap_id
        if submap_id is None:
            return None, NO_CANDIDATE
        is_there = [placed and one == submap_id for placed, one in zip(self.is_placed, self.submap_ids, strict=True)]
        known = PosedKeyframes(self.database, self.poses, self.log_scales, is_there)
        config = self.config
        return relocalize(
            query, known, config.place_recognition, self._verification_config(in_other_submap), config.relocalization
        )

    def _most_similar_submap(self, query: Keyframe) -> int | None:
        """Find the other submap with the most similar keyframe that is in the map; None without one."""
        keyframes = self.database.keyframes
        others = [row for row in range(len(keyframes)) if self._submap_id_of(row) != self.submap_id]
        others = [row for row in others if self.is_placed[keyframes[row].frame]]
        found = most_similar(self.database, query, others, 1, self.config.place_recognition)
        return self._submap_id_of(found[0].row) if found else None

    def _submap_id_of(self, row: int) -> int:
        """Submap of a keyframe, a row of the database."""
        return self.submap_ids[self.database.keyframes[row].frame]

    def _verification_config(self, is_free: bool) -> VerificationConfig:
        """Settings of the verification; the ratio of the two units is free where they may differ."""
        config = self.config.verification
        if self.has_one_unit and not is_free:
            return config
        return replace(config, alignment=replace(config.alignment, scale_std=math.inf))

    def consistent(self, since: int = 0) -> list[LoopMeasurement]:
        """Return the verified loops of queries from `since` on that are spatially consistent with others."""
        recent = [loop for loop in self.verified if loop.b >= since]
        poses, log_scales = (dict(enumerate(values)) for values in (self.poses, self.log_scales))
        yes = spatially_consistent(recent, self.violating, poses, log_scales, self.config.consistency)
        return [loop for loop, ok in zip(recent, yes, strict=True) if ok]

    def not_in_graph(self, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
        """Select the loops that are not in the pose graph yet."""
        known = {(loop.a, loop.b) for loop in self.accepted}
        return [loop for loop in loops if (loop.a, loop.b) not in known]

    def retract_inconsistent(self, consistent: Sequence[LoopMeasurement]) -> int:
        """Remove the factors of accepted loops not among all `consistent` ones; return their number."""
        good = {(loop.a, loop.b) for loop in consistent}
        before = len(self.accepted)
        self.accepted = [loop for loop in self.accepted if (loop.a, loop.b) in good]
        self.factors = [one for one in self.factors if one.kind != LOOP or (one.a, one.b) in good]
        return before - len(self.accepted)

    def _verify(self, row: int, other: int) -> None:
        keyframes = self.database.keyframes
        candidate = keyframes[other]
        beside = [
            keyframes[k] for k in (other - 1, other + 1) if 0 <= k < row and self._submap_id_of(k) == self.submap_id
        ]
        neighbours = neighbours_of(candidate, beside, self.poses, self.log_scales)
        loop, info = verify(keyframes[row], candidate, neighbours, self._verification_config(is_free=False))
        self._record((candidate.frame, keyframes[row].frame), loop, info)

    def _record(self, nodes: tuple[int, int], loop: LoopMeasurement | None, info: VerifyInfo) -> None:
        if info.violation is not None:
            self.violating.append(info.violation)
        if loop is None:
            self.refusals.append(Refusal(*nodes, info.refused_by.value, info.measured))
        else:
            self.verified.append(loop)

    def is_closure_due(self, loops: Sequence[LoopMeasurement]) -> bool:
        """Test whether a closure is due: a loop violates the current poses, and the last closure is long enough ago."""
        last = self.closures[-1].time if self.closures else -self.config.min_frames
        is_due = len(self.poses) - 1 - last >= self.config.min_frames
        return is_due and bool(self.violated(loops))

    def violated(self, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
        """Select the loops that the current poses violate: χ² above `min_violation`."""
        return [loop for loop in loops if self.chi2_of(loop) > self.config.min_violation]

    def chi2_of(self, loop: LoopMeasurement) -> float:
        """Compute χ² of a loop at the current poses and scales."""
        scale, other = self.log_scales[loop.a], self.log_scales[loop.b]
        now = rescaled(np.linalg.inv(self.poses[loop.a]) @ self.poses[loop.b], np.exp(-scale))
        error = np.linalg.inv(loop.Z_a_b) @ now
        turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
        return float(np.sum((loop.sqrt_info @ [*error[:3, 3], *turn, other - scale - loop.log_ratio]) ** 2))

    def close_loops(self, state: SlamState, loops: Sequence[LoopMeasurement] = ()) -> SlamState:
        """Optimize with `loops` as further factors and deform the map; a refused solution changes nothing."""
        factors = [*self.factors, *map(loop_factor, loops)]
        before, solver = self.nodes(self.submap_id), self.config.solver
        if not self.has_one_unit:  # the scales are not all about 1
            solver = replace(solver, scale_std=jnp.asarray(math.inf))
        after, info = optimize(PoseGraph(before, stack_factors(factors)), solver)
        self.closures.append(Closure(len(self.poses) - 1, tuple(loops), info))
        if info.reason:
            return state
        self.factors = factors
        self.accepted += loops
        count = len(self.poses)
        self.poses = list(np.asarray(after.T_world.as_matrix(), np.float64)[:count])
        self.log_scales = list(np.asarray(after.log_scale, np.float64)[:count])
        change = jnp.mean(after.log_scale - before.log_scale, where=before.valid)
        state = replace(state, estimate=rescale_estimate(state.estimate, jnp.exp(change)))
        return deform_state(state, before, after, self.min_std, self.config.deform)

    def nodes(self, submap_id: int | None = None) -> Nodes:
        """Stack all nodes, or mark those of a submap as valid; padded to a power of two, so that it compiles rarely."""
        count = len(self.poses)
        size = bucket(count)
        poses = to_se3(np.stack([*self.poses, *[np.eye(4)] * (size - count)]))
        scales = jnp.asarray([*self.log_scales, *[0.0] * (size - count)], jnp.float32)
        is_valid = [submap_id in (None, one) for one in self.submap_ids]
        return Nodes(poses, scales, jnp.asarray(is_valid + [False] * (size - count)))
