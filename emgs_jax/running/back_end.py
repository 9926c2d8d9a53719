"""The back end: a pose graph of keyframes and loop closures; optimized poses deform the map.

Nodes are the frames from the first of the map on, in the order of `SlamState.time`.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.geometry import Sim3, scale_pose
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
from emgs_jax.loop_closure.verification import LoopMeasurement, VerificationConfig, neighbours_of, verify
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


@dataclass(frozen=True)
class BackEnd:
    """State of the back end: nodes, factors and loops of the pose graph so far. Nothing of it is ever changed in place.

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
    poses: Sequence[np.ndarray] = field(default_factory=list)
    log_scales: Sequence[float] = field(default_factory=list)
    online: Sequence[np.ndarray] = field(default_factory=list)
    frames: Sequence[int] = field(default_factory=list)
    is_placed: Sequence[bool] = field(default_factory=list)
    submap_ids: Sequence[int] = field(default_factory=list)
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
    submap_id: int = 0
    has_one_unit: bool = True


def add_node(
    end: BackEnd, frame: FrameData, pose: np.ndarray, scale: float, origin: int | None, is_placed: bool = True
) -> BackEnd:
    """Add a node with the pose of its frame, and its sequential and map factors.

    Args:
        end: the back end.
        frame: its data.
        pose: T_world_camera.
        scale: of its inference.
        origin: node whose Gaussians it was registered to; None where it was not registered to the map.
        is_placed: the map holds it: it was registered to it, or the map was made from it.
    """
    time, pose = len(end.poses), np.asarray(pose, np.float64)
    end = replace(
        end,
        poses=[*end.poses, pose],
        online=[*end.online, pose],
        log_scales=[*end.log_scales, float(np.log(scale))],
        frames=[*end.frames, frame.index],
        is_placed=[*end.is_placed, is_placed],
        submap_ids=[*end.submap_ids, end.submap_id],
    )
    sequential = sequential_factor(frame, end.poses, end.log_scales, partial(_is_connected, end), end.config.noise)
    factors = [] if sequential is None else [sequential]
    if origin is not None and origin < time:
        factors.append(map_factor(frame, end.poses, end.log_scales, origin, end.config.noise))
    return replace(end, factors=[*end.factors, *factors])


def _is_connected(end: BackEnd, row: int) -> bool:
    """Test whether a node is in the map or has an odometry factor; False for nodes before the camera was found."""
    has_factor = any(factor.a == row and factor.kind == ODOMETRY for factor in end.factors)
    return row >= end.connected_since and (end.is_placed[row] or has_factor)


def detect_loops(end: BackEnd, frame: FrameData) -> BackEnd:
    """Add the last node as a keyframe, and verify its loop candidates."""
    time, config = len(end.poses) - 1, end.config.place_recognition
    if time % end.config.every:
        return end
    end = replace(end, database=add_keyframe(end.database, _keyframe(end, time, frame), config))
    row = len(end.database.keyframes) - 1
    for candidate in propose_candidates(end.database, row, config):
        if _submap_id_of(end, candidate.row) == end.submap_id:
            end = _verify_candidate(end, row, candidate.row)
    return end


def recent_loops(end: BackEnd) -> list[LoopMeasurement]:
    """Select spatially consistent loops of the last queries that are not in the pose graph yet, after a keyframe."""
    time = len(end.poses) - 1
    if time % end.config.every:
        return []
    return not_in_graph(end, consistent_loops(end, since=time - end.config.consistency.max_query_gap))


def _keyframe(end: BackEnd, time: int, frame: FrameData) -> Keyframe:
    return make_keyframe(time, frame.image, frame.points, frame.mask, end.intrinsics, end.config.place_recognition)


def relocalize_frame(
    end: BackEnd, frame: FrameData, in_other_submap: bool = False
) -> tuple[RelocalizedPose | None, str | None]:
    """Relocalize a frame by keyframes of its submap that are in the map; else return why that fails.

    Args:
        end: the back end.
        frame: of a frame that is no node yet, or is no keyframe.
        in_other_submap: search the other submap that has the most similar keyframe, with a free ratio of units.
    """
    query = _keyframe(end, len(end.poses), frame)
    submap_id = _most_similar_submap(end, query) if in_other_submap else end.submap_id
    if submap_id is None:
        return None, NO_CANDIDATE
    is_there = [placed and one == submap_id for placed, one in zip(end.is_placed, end.submap_ids, strict=True)]
    known = PosedKeyframes(end.database, end.poses, end.log_scales, is_there)
    verification = _verification_config(end, in_other_submap)
    return relocalize(query, known, end.config.place_recognition, verification, end.config.relocalization)


def _most_similar_submap(end: BackEnd, query: Keyframe) -> int | None:
    """Find the other submap with the most similar keyframe that is in the map; None without one."""
    keyframes = end.database.keyframes
    others = [row for row in range(len(keyframes)) if _submap_id_of(end, row) != end.submap_id]
    others = [row for row in others if end.is_placed[keyframes[row].frame]]
    found = most_similar(end.database, query, others, 1, end.config.place_recognition)
    return _submap_id_of(end, found[0].row) if found else None


def _submap_id_of(end: BackEnd, row: int) -> int:
    """Submap of a keyframe, a row of the database."""
    return end.submap_ids[end.database.keyframes[row].frame]


def _verification_config(end: BackEnd, is_free: bool) -> VerificationConfig:
    """Settings of the verification; the ratio of the two units is free where they may differ."""
    config = end.config.verification
    if end.has_one_unit and not is_free:
        return config
    return replace(config, alignment=replace(config.alignment, scale_std=math.inf))


def consistent_loops(end: BackEnd, since: int = 0) -> list[LoopMeasurement]:
    """Return the verified loops of queries from `since` on that are spatially consistent with others."""
    recent = [loop for loop in end.verified if loop.b >= since]
    poses, log_scales = (dict(enumerate(values)) for values in (end.poses, end.log_scales))
    yes = spatially_consistent(recent, end.violating, poses, log_scales, end.config.consistency)
    return [loop for loop, ok in zip(recent, yes, strict=True) if ok]


def not_in_graph(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select the loops that are not in the pose graph yet."""
    known = {(loop.a, loop.b) for loop in end.accepted}
    return [loop for loop in loops if (loop.a, loop.b) not in known]


def remove_inconsistent(end: BackEnd) -> BackEnd:
    """Remove the factors of accepted loops that are not spatially consistent any more."""
    good = {(loop.a, loop.b) for loop in consistent_loops(end)}
    accepted = [loop for loop in end.accepted if (loop.a, loop.b) in good]
    factors = [one for one in end.factors if one.kind != LOOP or (one.a, one.b) in good]
    return replace(end, accepted=accepted, factors=factors)


def _verify_candidate(end: BackEnd, row: int, other: int) -> BackEnd:
    """Verify a loop between two keyframes, rows of the database, the later first, and record the outcome."""
    keyframes = end.database.keyframes
    candidate, rows = keyframes[other], (k for k in (other - 1, other + 1) if 0 <= k < row)
    beside = [keyframes[k] for k in rows if _submap_id_of(end, k) == end.submap_id]
    neighbours = neighbours_of(candidate, beside, end.poses, end.log_scales)
    loop, info = verify(keyframes[row], candidate, neighbours, _verification_config(end, is_free=False))
    if info.violation is not None:
        end = replace(end, violating=[*end.violating, info.violation])
    if loop is not None:
        return replace(end, verified=[*end.verified, loop])
    refusal = Refusal(candidate.frame, keyframes[row].frame, info.refused_by.value, info.measured)
    return replace(end, refusals=[*end.refusals, refusal])


def is_closure_due(end: BackEnd, loops: Sequence[LoopMeasurement]) -> bool:
    """Test whether a closure is due: a loop violates the current poses, and the last closure is long enough ago."""
    last = end.closures[-1].time if end.closures else -end.config.min_frames
    return len(end.poses) - 1 - last >= end.config.min_frames and bool(violated(end, loops))


def violated(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select the loops that the current poses violate: χ² above `min_violation`."""
    return [loop for loop in loops if loop_chi2(end, loop) > end.config.min_violation]


def loop_chi2(end: BackEnd, loop: LoopMeasurement) -> float:
    """Compute χ² of a loop at the current poses and scales."""
    scale, other = end.log_scales[loop.a], end.log_scales[loop.b]
    now = scale_pose(np.linalg.inv(end.poses[loop.a]) @ end.poses[loop.b], np.exp(-scale))
    error = np.linalg.inv(loop.Z_a_b) @ now
    turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
    return float(np.sum((loop.sqrt_info @ [*error[:3, 3], *turn, other - scale - loop.log_ratio]) ** 2))


def close_loops(end: BackEnd, state: SlamState, loops: Sequence[LoopMeasurement] = ()) -> tuple[BackEnd, SlamState]:
    """Optimize with `loops` as further factors and deform the map; a refused solution moves nothing."""
    factors = [*end.factors, *map(loop_factor, loops)]
    before, solver = nodes_of(end, end.submap_id), end.config.solver
    if not end.has_one_unit:  # the scales are not all about 1
        solver = replace(solver, scale_std=jnp.asarray(math.inf))
    after, info = optimize(PoseGraph(before, stack_factors(factors)), solver)
    end = replace(end, closures=[*end.closures, Closure(len(end.poses) - 1, tuple(loops), info)])
    if info.reason:
        return end, state
    count = len(end.poses)
    end = replace(
        end,
        factors=factors,
        accepted=[*end.accepted, *loops],
        poses=list(np.asarray(after.T_world.as_matrix(), np.float64)[:count]),
        log_scales=list(np.asarray(after.log_scale, np.float64)[:count]),
    )
    change = jnp.mean(after.log_scale - before.log_scale, where=before.valid)
    state = replace(state, estimate=rescale_estimate(state.estimate, jnp.exp(change)))
    return end, deform_state(state, before, after, end.min_std, end.config.deform)


def transform_nodes(end: BackEnd, rows: Collection[int], similarity: Sim3) -> BackEnd:
    """Map the poses and scales of some nodes to another world."""

    def moved(poses: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [similarity.apply_to_poses(pose) if row in rows else pose for row, pose in enumerate(poses)]

    change = float(np.log(similarity.scale))
    log_scales = [scale + change if row in rows else scale for row, scale in enumerate(end.log_scales)]
    return replace(end, poses=moved(end.poses), online=moved(end.online), log_scales=log_scales)


def nodes_of(end: BackEnd, submap_id: int | None = None) -> Nodes:
    """Stack all nodes, or mark those of a submap as valid; padded to a power of two, so that it compiles rarely."""
    count = len(end.poses)
    size = bucket(count)
    poses = to_se3(np.stack([*end.poses, *[np.eye(4)] * (size - count)]))
    scales = jnp.asarray([*end.log_scales, *[0.0] * (size - count)], jnp.float32)
    is_valid = [submap_id in (None, one) for one in end.submap_ids]
    return Nodes(poses, scales, jnp.asarray(is_valid + [False] * (size - count)))
