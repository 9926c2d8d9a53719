"""One run of the pipeline as far as it is: the state, the poses and what became of each frame."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.localization import REASONS
from emgs_jax.ops.camera import Camera
from emgs_jax.running.clock import Clock
from emgs_jax.running.convert import to_camera
from emgs_jax.slam import FirstWindow, SlamConfig, SlamState, StepInfo


@dataclass(frozen=True)
class FrameRecord:
    """What became of one frame: a line of frames.jsonl. None where a frame was not a step.

    Args:
        index: position in the data set.
        name: of the image.
        timestamp: of the data set.
        status: tracked, degraded (the coarse pose stays, nothing is fused), lost (not even that is known),
            initialization (the map was made from it) or skipped (it cannot be read).
        reason: why it is not tracked.
        pose: T_world_camera as tx, ty, tz (m), qx, qy, qz, qw.
        newest_pose: temporary pose of the next frame, likewise.
        inliers: points that agree with the map.
        residual: of these to the map's planes, m.
        scale: by which the prediction was multiplied.
        fused: points that moved Gaussians.
        refined: candidates that were merged on the image plane.
        new: candidates that became Gaussians.
        num_gaussians: in the map after this frame.
        overflow: splats that found their tile full.
        seconds: of mapping (conversion and step), compilation included.
        compile_seconds: of these.
    """

    index: int
    name: str | None
    timestamp: float | None
    status: str
    reason: str | None = None
    pose: tuple[float, ...] | None = None
    newest_pose: tuple[float, ...] | None = None
    inliers: int | None = None
    residual: float | None = None
    scale: float | None = None
    fused: int | None = None
    refined: int | None = None
    new: int | None = None
    num_gaussians: int | None = None
    overflow: int | None = None
    seconds: float = 0.0
    compile_seconds: float = 0.0


@dataclass
class MappingRun:
    """A run as far as it is. It grows with each frame, so an interrupted one still holds what it has.

    Args:
        camera: of the frames.
        config: all stages; capacities grow where they must.
        clock: counts load, predict and map.
        on_record: hears of each frame at once.
        state: None before the first window.
        records: of the frames in use, in order.
        poses: T_world_camera (4, 4) of each record.
        raw_poses: what the prior alone says, likewise; the pose before where it says none.
        true_poses: None where unknown.
    """

    camera: Camera
    config: SlamConfig
    clock: Clock = field(default_factory=Clock)
    on_record: Callable[[dict[str, Any]], None] = lambda record: None
    state: SlamState | None = None
    records: list[FrameRecord] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    raw_poses: list[np.ndarray] = field(default_factory=list)
    true_poses: list[np.ndarray | None] = field(default_factory=list)


def new_run(
    dataset: Dataset,
    config: SlamConfig,
    clock: Clock | None = None,
    on_record: Callable[[dict[str, Any]], None] = lambda record: None,
) -> MappingRun:
    """A run of `dataset` before its first frame."""
    return MappingRun(to_camera(dataset), config, Clock() if clock is None else clock, on_record)


def record_step(run: MappingRun, frame: Frame, info: StepInfo, spent: dict[str, float]) -> None:
    """Add what a step did, `info` on the host, and the seconds that it took."""
    _add(run, frame, _matrix(info.T_world_camera.wxyz_xyz), _described(info) | spent)


def record_initialization(run: MappingRun, window: FirstWindow, frames: list[Frame], spent: dict[str, float]) -> None:
    """Add the frames that the map of `run.state` was made from; raises ValueError where that map is empty."""
    poses = np.asarray(window.T_world_views.wxyz_xyz)
    count = int(np.asarray(run.state.map.gaussians.valid).sum())
    if count == 0:  # no later frame could be localised in it
        raise ValueError(
            f"the map is empty after {len(poses)} view(s) from {frames[0].name}: the prior has no valid point there; "
            "begin elsewhere (dataset.start=...) or use slam.initialization=merged"
        )
    for frame, pose in zip(frames, poses, strict=False):
        described = {"status": "initialization", "pose": _tum(pose), "num_gaussians": count}
        _add(run, frame, _matrix(pose), described | {key: value / len(poses) for key, value in spent.items()})


def record_before_map(run: MappingRun, frame: Frame, pose: np.ndarray) -> None:
    """Add a frame with nothing to start a map from; `pose` (4, 4) stands in for the one that is not known."""
    _add(run, frame, pose, {"status": "lost", "reason": REASONS[0]})


def _add(run: MappingRun, frame: Frame, pose: np.ndarray, described: dict[str, Any]) -> None:
    record = FrameRecord(frame.index, frame.name, frame.timestamp, **described)
    run.records.append(record)
    run.poses.append(pose)
    run.true_poses.append(frame.T_world_camera)
    run.on_record(asdict(record))


def _described(info: StepInfo) -> dict[str, Any]:
    """The fields of a record that a step fills; `info` is on the host."""
    localization = info.localization
    reasons = [words for bit, words in enumerate(REASONS) if int(localization.reason) >> bit & 1]
    return {
        "status": "tracked" if localization.is_tracked else "lost" if localization.is_lost else "degraded",
        "reason": "; ".join(reasons) or None,
        "pose": _tum(info.T_world_camera.wxyz_xyz),
        "newest_pose": _tum(info.T_world_newest.wxyz_xyz),
        "inliers": int(localization.icp.num_inliers),
        "residual": float(localization.icp.residual),
        "scale": float(localization.scale),
        "fused": int(info.em.num_fused),
        "refined": int(info.refinement.num_merged),
        "new": int(info.refinement.num_fresh),
        "num_gaussians": int(info.num_gaussians),
        "overflow": int(info.overflow.tiles),
    }


class Timer:
    """Seconds since it was made, and what of them was compilation."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._begin, self._compiled = clock, perf_counter(), clock.compile_seconds

    def read(self) -> dict[str, float]:
        compiled = self._clock.compile_seconds - self._compiled
        return {"seconds": perf_counter() - self._begin, "compile_seconds": compiled}


def _matrix(wxyz_xyz: np.ndarray) -> np.ndarray:
    """(4, 4) float64 of a pose as jaxlie holds it."""
    pose, (w, x, y, z, *translation) = np.eye(4), np.asarray(wxyz_xyz, np.float64)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), translation
    return pose


def _tum(wxyz_xyz: np.ndarray) -> tuple[float, ...]:
    w, x, y, z, *translation = (float(value) for value in np.asarray(wxyz_xyz))
    return (*translation, x, y, z, w)
