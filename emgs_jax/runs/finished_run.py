"""A finished run, read from its folder and checked once, for everything that shows it."""

import json
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emgs_jax.config.values import check_value, declared
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.features.text import TextEmbeddings, read_text
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.io.map_file import load_map
from emgs_jax.io.trajectory import from_tum, load_trajectory_tum
from emgs_jax.mapping.records import UNPLACED
from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import RenderConfig
from emgs_jax.runs.provenance import is_in_metres
from emgs_jax.runs.results import METRICS_FILE, read_metrics, sound

TEXT_FILE = "text.npz"  # classes of a map with features, in the format of `experiments.embed`
LOOPS_FILE = "loops.json"
REPORT_FILE = "report.html"
FRAMES_FILE = "frames.jsonl"
POINTS_FILE = "points.ply"
SPLATS_FILE, POLISHED_PATH_FILE = "splats.ply", "polish.txt"  # splats, and the poses to which they were fitted
POLISH = (SPLATS_FILE, "polish.json", "polish.png", "polish.npz", POLISHED_PATH_FILE)  # of `experiments.polish`
EXPORTS = ("colmap", "nerfstudio", "cameras.ply", "scaled", "upright")  # what `experiments.export` writes beside them
_PROVENANCE = {"protocol": (str, type(None)), "simulated": bool, "git": (dict, type(None))} | {
    # The parts of `provenance.provenance` that are read again, by dotted key.
    **dict.fromkeys(("prior", "data", "versions", "device", "config"), dict),
    **dict.fromkeys(("prior.settings", "config.densify", "config.densify.render"), dict),
    **dict.fromkeys(("prior.name", "data.name", "data.sequence", "versions.emgs_jax", "device.kind"), str),
}
_WORDS = ("_note", "/reason")  # endings of metrics that are no numbers
_OUTCOMES = ("accepted", "known", "unconfirmed", "unsolved", "refused")


@dataclass(frozen=True)
class FinishedRun:
    """Outputs of a finished run; poses are T_world_camera of `frames`, (n, 4, 4) float64."""

    folder: Path
    metrics: dict[str, Any]
    frames: list[dict[str, Any]]  # lines of frames.jsonl that have a pose, in order
    skipped: list[dict[str, Any]]  # the other lines
    poses: np.ndarray  # the final ones; where `is_placed` is false a guess
    online: np.ndarray | None  # as first estimated; nan before the back end begins or unplaced, None without one
    raw: np.ndarray  # of the prior, nan where unknown
    truth: np.ndarray  # nan where unknown
    map: GaussianMap
    camera: Camera
    text: TextEmbeddings | None  # classes that the map's features are compared with
    loops: list[dict[str, Any]]  # lines of loops.json; empty without a back end

    @property
    def provenance(self) -> dict[str, Any]:
        """Provenance of the result, as in metrics.json."""
        return self.metrics["provenance"]

    @property
    def has_truth(self) -> np.ndarray:
        """Whether each frame has a true pose, bool (n,)."""
        return np.isfinite(self.truth).all((1, 2))

    @property
    def is_placed(self) -> np.ndarray:
        """Whether each frame's pose is meaningful, bool (n,); a lost frame's is a guess."""
        return np.array([frame["status"] not in UNPLACED for frame in self.frames], bool)

    @property
    def metre(self) -> float:
        """What a metre of the settings was in the unit of the map, see `Prior.metre`."""
        return self.provenance.get("metre", 1.0)

    @property
    def is_metric(self) -> bool:
        """Whether lengths of the map are meant to be metres."""
        return is_in_metres(self.provenance)


def read_run(folder: Path) -> FinishedRun:
    """Read the folder of a finished run of this version; otherwise raise ValueError with the file and the remedy."""
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder: give the one that a run wrote, with metrics.json in it")
    needed = METRICS_FILE, FRAMES_FILE, "trajectory.txt", "map.npz"
    if missing := [name for name in needed if not (folder / name).is_file()]:
        raise ValueError(f"{folder} holds no finished run: it lacks {', '.join(missing)}; run it to its end")
    metrics = read_metrics(folder / METRICS_FILE, "run again")
    _check_metrics(folder / METRICS_FILE, metrics)
    lines = _lines(folder / FRAMES_FILE)
    frames = [line for line in lines if line.get("pose") is not None]
    placed = [row for row, line in enumerate(frames) if line["status"] not in UNPLACED]
    times, path = load_trajectory_tum(folder / "trajectory.txt")
    taken = np.array([line.get("timestamp", np.nan) for line in frames], np.float64)
    if len(path) == len(frames) and np.allclose(times, taken, atol=1e-5):  # earlier versions wrote guesses, too
        path = path[placed]
    if len(placed) != len(path):
        counts = f"frames.jsonl has {len(placed)} frames that are placed and trajectory.txt {len(path)}"
        raise ValueError(f"{folder}: {counts}: they are of two runs, or one was cut off; run again")
    poses, raw, truth = (_poses(folder / FRAMES_FILE, frames, name) for name in ("pose", "raw_pose", "true_pose"))
    poses[placed] = path
    return FinishedRun(
        folder=folder,
        metrics=metrics,
        frames=frames,
        skipped=[line for line in lines if line.get("pose") is None],
        poses=poses,
        online=_online(folder / "trajectory_online.txt", placed, len(poses)),
        raw=raw,
        truth=truth,
        map=load_map(folder / "map.npz"),
        camera=_camera(folder / METRICS_FILE, metrics),
        text=read_text(folder / TEXT_FILE) if (folder / TEXT_FILE).is_file() else None,
        loops=_loops(folder / LOOPS_FILE, len(poses)),
    )


def _check_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Raise ValueError if a value is neither a number nor unknown, or what is said of the run lacks something."""

    def require(holds: bool, fault: str) -> None:
        if not holds:
            raise ValueError(f"{path} is not the result of a run ({fault}): run again")

    for key, value in metrics.items():
        kinds = str if key.endswith(_WORDS) else int | float
        require(key == "provenance" or value is None or isinstance(value, kinds), f"{key} is {value!r}")
    block = metrics["provenance"]
    for key, kinds in _PROVENANCE.items():
        *parents, name = key.split(".")
        parent = reduce(getitem, parents, block)  # the rows before have checked these
        require(name in parent and isinstance(parent[name], kinds), f"provenance.{key} is {parent.get(name)!r}")
    has_revision = block["git"] is None or isinstance(block["git"].get("revision"), str)
    require(has_revision, "provenance.git has no revision")


def _lines(path: Path) -> list[dict[str, Any]]:
    lines = []
    for number, text in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        with sound(f"{path}:{number} is no record of a frame"):
            lines.append(json.loads(text))
            if not isinstance(lines[-1]["index"], int) or not isinstance(lines[-1]["status"], str):
                raise TypeError("index and status must be a number and a word")
    return lines


def _poses(path: Path, frames: list[dict[str, Any]], name: str) -> np.ndarray:
    with sound(f"{path}: some {name} is not the seven numbers of a pose"):
        rows = [[np.nan] * 7 if line.get(name) is None else line[name] for line in frames]
        return from_tum(np.array(rows, np.float64).reshape(len(frames), 7))


def _online(path: Path, placed: list[int], count: int) -> np.ndarray | None:
    """Return the poses as first estimated of the last of the rows that are placed, nan elsewhere."""
    if not path.is_file():
        return None
    _, poses = load_trajectory_tum(path)
    if len(poses) > len(placed):
        found = f"{len(poses)} poses and trajectory.txt {len(placed)}"
        raise ValueError(f"{path} has {found}: they are of two runs; run again")
    online = np.full((count, 4, 4), np.nan)
    online[placed[len(placed) - len(poses) :]] = poses
    return online


def _camera(path: Path, metrics: dict[str, Any]) -> Camera:
    """Return the camera of the frames, undistorted and in the size in use."""
    with sound(f"{path} does not say which camera it was: an older version wrote it"):
        known = metrics["provenance"]["data"]["frames"]
        fx, fy, cx, cy = (float(value) for value in known["intrinsics"])
        return Camera((fx, fy), (cx, cy), *(int(value) for value in known["size"]))


def _loops(path: Path, count: int) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with sound(f"{path} is no list of loops"):
        loops = json.loads(path.read_text(encoding="utf-8"))
        ends = [loop[name] for loop in loops for name in ("frame", "other")]
        is_known = all(0 <= end < count for end in ends) and {loop["outcome"] for loop in loops} <= {*_OUTCOMES}
    if not is_known:
        raise ValueError(f"{path} names frames or outcomes that this run does not have: run again")
    return loops


def render_config(run: FinishedRun) -> RenderConfig:
    """Read the run's settings of densification; raise ValueError for settings of another version."""
    settings = dict(run.provenance["config"]["densify"]["render"])
    settings.pop("_target_", None)
    with sound(f"{run.folder}/{METRICS_FILE} has settings of another version"):
        for name, field in declared(RenderConfig).items():
            check_value(f"densify.render.{name}", settings.get(name), field)
        return RenderConfig(**settings)


class PlacedPaths(NamedTuple):
    """Paths in the frame of the map, (n, 4, 4), nan where unknown, and errors of positions (n,) in metres."""

    truth: np.ndarray
    raw: np.ndarray
    errors: dict[str, np.ndarray]


def placed_paths(run: FinishedRun) -> PlacedPaths:
    """Align the true path and the raw prior's with ours, and return the remaining differences.

    Each path is aligned with the true one separately, over the placed frames, as for its error in metrics.json. Without
    truth, the raw prior's path stays where it is; in a run that continues a saved map it has its own world and unit, so
    it is aligned with ours.
    """
    known, with_scale = run.has_truth, run.provenance["config"].get("evaluation", {}).get("alignment") == "sim3"
    back, raw, errors = None, run.raw, {}
    for name, poses in (("ours", run.poses), ("online", run.online), ("raw", run.raw)):
        rows = known & run.is_placed & (poses is not None and np.isfinite(poses).all((1, 2)))
        if rows.any():
            alignment, _ = align_poses(poses[rows], run.truth[rows], with_scale)
            off = np.linalg.norm(alignment.apply(poses[:, :3, 3]) - run.truth[:, :3, 3], axis=1)
            errors[name] = np.where(run.is_placed, off, np.nan)
            back = alignment.inverse() if back is None else back
            raw = back.apply_to_poses(alignment.apply_to_poses(poses)) if name == "raw" else raw
    is_shown = run.is_placed & np.isfinite(run.raw).all((1, 2))
    if back is None and run.provenance["config"].get("map") is not None and is_shown.any():
        raw = align_poses(run.raw[is_shown], run.poses[is_shown], True)[0].apply_to_poses(run.raw)
    truth = run.truth if back is None else np.where(known[:, None, None], back.apply_to_poses(run.truth), np.nan)
    return PlacedPaths(truth, raw, errors)
