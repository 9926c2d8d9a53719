"""State of a run, and a record of each of its frames.

A pose is a (4, 4) float64 matrix, camera -> world, everywhere on the host; files write it as TUM's seven numbers.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import jax
import jaxlie
import numpy as np

from emgs_jax.back_end.saved_map import SavedMap
from emgs_jax.back_end.state import BackEnd, BackEndConfig
from emgs_jax.data.base import Dataset
from emgs_jax.device.arrays import to_matrix
from emgs_jax.device.clock import Clock
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import MIN_ROWS, REFERENCE
from emgs_jax.geometry import seen_from
from emgs_jax.io.run_lengths import to_run_lengths
from emgs_jax.localization import REASONS
from emgs_jax.loop_closure.prior_query import PriorQuery
from emgs_jax.mapping.convert import to_camera
from emgs_jax.mapping.records import APART, HIDDEN, NEW_SUBMAP, NOT_FOUND, RESTARTED, FrameRecord
from emgs_jax.mapping.window_input import PlacedStructure, WindowInput
from emgs_jax.observation import Prediction
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.slam import SlamConfig, SlamState, StepInfo

MOST_MOVING = 0.5  # of the pixels; where more move it is they that hide the map
Seconds = Mapping[str, float]  # as a `Timer` reads


@dataclass(frozen=True)
class LeftWorld:
    """A world of the prior when the run went on in another: `structure` and `prior_motion` then, and its submap."""

    structure: PlacedStructure | None
    prior_motion: jaxlie.SE3 | None
    submap_id: int


@dataclass(frozen=True)
class MappingRun:
    """State of a run so far. Nothing of it is ever changed in place: each input makes a new one.

    Args:
        clock: counts load, predict and map.
        state: None before the first window.
        back_end: optimizes poses and deforms the map; None: poses stay as first estimated.
        saved: map of an earlier run that this one continues; None: it makes its own map.
        prior_motion: of the prior's world since relocalization; None: the identity.
        structure: pose of the prior's own world, if it is not related to the first frame any more.
        inactive: states of the other disconnected submaps, by their number.
        apart: states of submaps that were never joined, when the run has ended.
        worlds: other worlds of the prior that the run has been in, by their number.
        prior_query: predicts both visits of a loop, see `prior_queries`.
        first_covariance: (6, 6) of the first frame, as frames were placed, when the run has ended (`with_first_frame`).
    """

    camera: Camera
    config: SlamConfig
    clock: Clock = field(default_factory=Clock)
    state: SlamState | None = None
    records: Sequence[FrameRecord] = ()
    back_end: BackEnd | None = None
    saved: SavedMap | None = None
    prior_motion: jaxlie.SE3 | None = None
    structure: PlacedStructure | None = None
    inactive: Mapping[int, SlamState] = field(default_factory=dict)
    apart: Mapping[int, SlamState] = field(default_factory=dict)
    worlds: Mapping[int, LeftWorld] = field(default_factory=dict)
    prior_query: PriorQuery = lambda a, b: None
    first_covariance: np.ndarray | None = None

    @property
    def is_fixed(self) -> bool:
        """True in localization mode: a saved map and its pose graph stay as they are."""
        return self.saved is not None and self.saved.is_fixed

    @property
    def map(self) -> GaussianMap | None:
        """All Gaussians; None before the first window."""
        return None if self.state is None else self.state.map

    @property
    def poses(self) -> np.ndarray:
        """T_world_camera of each record, (n, 4, 4)."""
        return _stacked([record.pose for record in self.records])

    @property
    def raw_poses(self) -> np.ndarray:
        """Raw predictions of the poses, likewise."""
        return _stacked([record.raw_pose for record in self.records])

    @property
    def true_poses(self) -> list[np.ndarray | None]:
        """True poses of the data set, likewise; None where unknown."""
        return [record.true_pose for record in self.records]


def new_run(
    dataset: Dataset,
    config: SlamConfig,
    clock: Clock | None = None,
    graph: BackEndConfig | None = None,
    saved: SavedMap | None = None,
) -> MappingRun:
    """Make a run of `dataset` before its first frame; `graph` gives it a back end, `saved` that of an earlier run.

    Raises:
        ValueError: `saved`, and the map of the first window is to be made from all of its views at once; or JAX
            computes in float64.
    """
    if jax.config.jax_enable_x64:
        raise ValueError(
            'JAX_ENABLE_X64 is set, and maps are made in float32: jax.config.update("jax_enable_x64", False) turns it '
            "off, or unset JAX_ENABLE_X64"
        )
    back_end = None if graph is None else BackEnd(graph, tuple(dataset.intrinsics), float(config.fit.min_std))
    clock, camera = Clock() if clock is None else clock, to_camera(dataset)
    for words in clamped(config, camera):
        warn_once(words)
    if saved is None:
        return MappingRun(camera, config, clock, back_end=back_end)
    if config.initialization == "merged":
        raise ValueError("map= places one view after the other: use slam.initialization=incremental with it")
    config = replace(config, submap=replace(config.submap, map_capacity=saved.map.weight.shape[0]))
    return MappingRun(camera, config, clock, back_end=saved.back_end, saved=saved)


def clamped(config: SlamConfig, camera: Camera) -> list[str]:
    """Say which settings have no effect on images of this size, and what is done instead."""
    found, least = [], MIN_ROWS * config.observation.thin**2 * REFERENCE / (camera.width * camera.height)
    if config.fit.points_per_gaussian < math.floor(least):
        found.append(
            f"slam.fit.points_per_gaussian={config.fit.points_per_gaussian} makes the Gaussians of "
            f"{math.floor(least)}: fewer than {MIN_ROWS} points of an image of {camera.width}×{camera.height} with "
            f"slam.observation.thin={config.observation.thin} have no covariance"
        )
    if config.em.num_neighbours > config.em.num_candidates:
        found.append(
            f"slam.em.num_neighbours={config.em.num_neighbours} finds no more than "
            f"slam.em.num_candidates={config.em.num_candidates}"
        )
    return found


@cache
def warn_once(words: str) -> None:
    """Print a warning that no later run of this process repeats."""
    print(f"warning: {words}", file=sys.stderr)


@dataclass(frozen=True)
class TrackedFrame:
    """A frame after its step.

    Args:
        info: result of the step; None where the camera has no pose yet.
        location: outcome of relocalization, see `FrameRecord`; None without one.
        similarity: from its submap to the one that it joins, likewise.
    """

    prediction: Prediction | None = None
    info: StepInfo | None = None
    location: str | None = None
    similarity: np.ndarray | None = None


def record_lost(run: MappingRun, window: WindowInput, location: str | None = None) -> MappingRun:
    """Record a lost frame before a map can start; its pose is the anchor's or the last one, a placeholder."""
    reason, pose = REASONS[0] if location is None else NOT_FOUND, window.T_world_anchor
    if run.saved is not None:
        pose = run.records[-1].pose if run.records else run.saved.back_end.nodes[-1].pose
    return _add(run, window, 0, status="lost", reason=reason, location=location, pose=pose)


def record_start(run: MappingRun, window: WindowInput, seconds: Seconds) -> MappingRun:
    """Record the frames that the map was made from; raise ValueError where that map is empty."""
    poses = np.asarray(window.prediction.T_world_views.wxyz_xyz)
    count = int(np.asarray(run.map.gaussians.valid).sum())
    if count == 0:  # no later frame could be localised in it
        raise ValueError(
            f"the map is empty after {len(poses)} view(s) from {window.frames[0].name}: the prior has no valid "
            "point there; begin elsewhere (dataset.start=...) or use slam.initialization=merged"
        )
    share = {key: value / len(poses) for key, value in seconds.items()}
    for row, pose in enumerate(poses):
        described = {"status": "initialization", "pose": to_matrix(pose), "scale": 1.0, "num_gaussians": count}
        run = _add(run, window, row, **share, **described)
    return run


def record_new_submap(run: MappingRun, window: WindowInput, seconds: Seconds) -> MappingRun:
    """Record the first frame of a disconnected submap; its pose is that of the frame before, a placeholder."""
    count = int(np.asarray(run.map.gaussians.valid).sum())
    kept = {"status": "initialization", "pose": run.records[-1].pose, "new": count, "num_gaussians": count}
    return _add(run, window, 0, **kept, scale=1.0, location=NEW_SUBMAP, **seconds)


def record_step(run: MappingRun, window: WindowInput, frame: TrackedFrame, seconds: Seconds) -> MappingRun:
    """Record a step and the seconds that it took."""
    info = jax.device_get(frame.info)
    kept = {"fused": 0, "updated": 0, "new": 0, "num_gaussians": run.saved.count} if run.is_fixed else {}
    if frame.location == RESTARTED:
        count = int(np.asarray(run.map.gaussians.valid).sum())
        kept = {"status": "initialization", "new": count - int(info.num_gaussians), "num_gaussians": count}
    outcome = {"location": frame.location, "similarity": frame.similarity}
    fields = _step_fields(info, downscale(run.camera, run.config.observation.thin))
    of_map, by_map = covariance_of_map(run, fields["pose"], fields["origin"]), info.localization.by_map
    fields["covariance"] = fields["covariance"] + by_map @ of_map @ by_map.T
    return _add(run, window, 0, **fields | kept | outcome, **seconds)


def covariance_of_map(run: MappingRun, pose: np.ndarray, origin: int | None) -> np.ndarray:
    """Covariance (6, 6), seen from a pose, of the part of the map it was registered to, relative to the first frame.

    That part errs as a whole by what the frame erred that it was made of, the origin: on a way out errors add up from
    one origin to the next, and where a place is seen again they are what they were. A frame that nothing in the map
    explains has the origin of the frame before. A saved map is exact.
    """
    rows = (_row_of_node(run, one) for one in (origin, *(record.origin for record in reversed(run.records))))
    row = next((row for row in rows if row is not None and row < len(run.records)), None)
    there = None if row is None else run.records[row]
    if there is None or there.covariance is None:
        return np.zeros((6, 6))
    return seen_from(there.covariance, there.pose, pose[None])[0]


def _row_of_node(run: MappingRun, node: int | None) -> int | None:
    """Return the row of the record of a frame that is counted from the map's first one; None of one in a saved map."""
    if run.saved is None:
        first = next(row for row, record in enumerate(run.records) if record.status == "initialization")
        return None if node is None else first + node
    first_node = run.back_end.first_node
    return None if node is None or node < first_node else row_of_first_node(run) + node - first_node


def _add(run: MappingRun, window: WindowInput, row: int, **described: Any) -> MappingRun:
    """Append the record of a frame of a window."""
    frame = window.frames[row]
    record = FrameRecord(
        index=frame.index,
        name=frame.name,
        timestamp=frame.timestamp,
        raw_pose=window.raw[row].T_world_camera,
        true_pose=frame.T_world_camera,
        left_out=window.raw[row].num_left_out,
        **described,
    )
    return replace(run, records=(*run.records, record))


def _step_fields(info: StepInfo, view: Camera) -> dict[str, Any]:
    """Return the fields of a record that a step fills; `info` is on the host, `view` the camera of its rows."""
    localization, em, refinement = info.localization, info.em, info.refinement
    reasons = [words for bit, words in enumerate(REASONS) if int(localization.reason) >> bit & 1]
    moving = float(np.mean(info.moving))
    pixels = to_run_lengths(info.moving.reshape(view.height, view.width)) if moving else None
    reasons = [HIDDEN] if reasons and moving > MOST_MOVING else reasons
    return {
        "status": "tracked" if localization.is_tracked else "lost" if localization.is_lost else "degraded",
        "reason": "; ".join(reasons) or None,
        "pose": to_matrix(info.T_world_camera.wxyz_xyz),
        "newest_pose": to_matrix(info.T_world_newest.wxyz_xyz),
        "covariance": np.asarray(localization.estimate.covariance, np.float64)[:-1, :-1],
        "inliers": int(localization.icp.num_inliers),
        "residual": float(localization.icp.residual),
        "scale": float(localization.scale),
        "depth_noise": float(localization.depth_noise) if int(localization.icp.num_inliers) else None,
        "step_m": float(localization.step_m),
        "step_rad": float(localization.step_rad),
        "origin": int(info.origin) if localization.is_tracked else None,
        "repeat_rms": float(localization.repeat_rms),
        "moving": moving,
        "moving_pixels": pixels,
        "fused": int(em.num_fused),
        "updated": int(em.num_updated),
        "mean_log_joint": float(em.mean_log_joint) if em.num_fused else None,
        "candidates": int(refinement.num_candidates),
        "refined": int(refinement.num_merged),
        "new": int(refinement.num_fresh),
        "num_gaussians": int(info.num_gaussians),
        "overflow": int(info.overflow.tiles),
    }


def row_of_first_node(run: MappingRun) -> int:
    """Return the row of the first record that is a node of the back end; all later ones are nodes, too."""
    return len(run.records) - (len(run.back_end.nodes) - run.back_end.first_node)


def with_truth(run: MappingRun, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return poses and true poses (n, 4, 4) of the frames whose truth is known; None without any.

    Frames of submaps that were never joined are left out: their poses are in a world of their own.
    """
    rows = zip(poses, run.true_poses, run.records, strict=True)
    pairs = [(pose, true) for pose, true, record in rows if true is not None and record.status != APART]
    if not pairs:
        return None
    estimate, truth = zip(*pairs, strict=True)
    return np.stack(estimate), np.stack(truth).astype(np.float64)


def _stacked(poses: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(poses) if poses else np.zeros((0, 4, 4))
