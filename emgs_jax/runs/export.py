"""Export a finished run to the formats of other programs (COLMAP, nerfstudio, cameras as a mesh), or to metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.drawing.colors import OURS, STATUS_COLORS, rgb, save_png
from emgs_jax.drawing.overview import view_from_above
from emgs_jax.gaussian_map import transformed
from emgs_jax.geometry import Sim3
from emgs_jax.io.cameras import save_colmap, save_frustums, save_transforms
from emgs_jax.io.files import new_folder, write_json
from emgs_jax.io.map_file import save_map
from emgs_jax.io.ply import with_colors, write_ply
from emgs_jax.io.ply_reader import read_vertices, transform_ply
from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum
from emgs_jax.mapping.records import UNPLACED
from emgs_jax.ops.ranges import number, one_of
from emgs_jax.prior.base import UP_KEYS
from emgs_jax.runs.finished_run import POINTS_FILE, POLISHED_PATH_FILE, SPLATS_FILE, FinishedRun
from emgs_jax.runs.moving import moving_mask

FORMATS = {"colmap": "colmap", "nerfstudio": "nerfstudio", "frustums": "cameras.ply"}  # and what is written
IMAGE_FORMATS = {"colmap", "nerfstudio"}
TRAJECTORIES = "trajectory.txt", "trajectory_online.txt", POLISHED_PATH_FILE
CLOUDS = "map.ply", "points.ply", "mesh.ply", SPLATS_FILE
MOVED_FILE = "T_export_map.json"  # y = T x, a similarity, of points x of the run and y of the export
SHORTEST = 1e-6  # of the run's unit; a shorter distance between two cameras does not determine a scale


@dataclass(frozen=True)
class ExportConfig:
    """Settings of an export of a run: formats, size and scale."""

    formats: Sequence[str]
    max_points: int = number(low=1, high=2**26)
    scale: float | None = number(low=1e-6, high=1e6)  # factor on all lengths; None = 1
    length: Sequence[float] | None = number(low=0, high=2**31)  # instead of it, see `factor_of`
    # As in the run, or in the size on disk; undistorted either way.
    images: str = one_of("used", "original", default="used")
    # Moving things stay in the images, or each image has a mask that is black there.
    moving: str = one_of("kept", "masked", default="kept")
    up: str = one_of("run", "z", default="run")  # the run's own world, or turned such that z is up


def export(run: FinishedRun, folder: Path, config: ExportConfig, dataset: ReadableFrames | None) -> list[Path]:
    """Write a run into an existing `folder`, in the run's unit; return what was written.

    Raises ValueError, and writes nothing, for an unknown format, for one that lacks its images or points, or if the
    place of an export is taken.
    """
    if unknown := [name for name in config.formats if name not in FORMATS]:
        raise ValueError(f"formats={unknown[0]} is not known: choose of {', '.join(FORMATS)}")
    if taken := [folder / FORMATS[name] for name in config.formats if (folder / FORMATS[name]).exists()]:
        raise ValueError(f"{taken[0]} is there already: remove it, or write elsewhere with out=FOLDER")
    for name in IMAGE_FORMATS & {*config.formats}:
        if dataset is None:
            raise ValueError(f"formats={name} holds the images, which are not there; formats=[frustums] needs none")
        if not (run.folder / POINTS_FILE).is_file():
            raise ValueError(f"{run.folder} lacks {POINTS_FILE}, which formats={name} needs: run again")
    for name in config.formats:
        if name == "frustums":
            _frustums(run, folder / FORMATS[name])
        else:
            with new_folder(folder / FORMATS[name]) as new:
                _project(run, new, dataset, config, is_colmap=name == "colmap")
    return [folder / FORMATS[name] for name in config.formats]


def find_factor(run: FinishedRun, config: ExportConfig) -> float | None:
    """Return the factor on all lengths of a run, from `scale` or `length`; None if neither is given."""
    if config.length is None:
        return config.scale
    if config.scale is not None:
        raise ValueError("scale= and length= both say how long things are: give one of them")
    return factor_of(run, config.length)


def _project(run: FinishedRun, folder: Path, dataset: ReadableFrames, config: ExportConfig, is_colmap: bool) -> None:
    """Write images/ and masks/ of the placed frames, and sparse/0/ of COLMAP or nerfstudio's transforms.json.

    An image is undistorted and in the run's size. Its name is the frame's number, with one dot, because 3DGS cuts names
    at the first one. A mask is black where something moves; for COLMAP it is named like the image plus .png.
    """
    rows, size = np.flatnonzero(run.is_placed), (run.camera.width, run.camera.height)
    names, masks = [f"{run.frames[row]['index']:06d}.png" for row in rows], []
    (folder / "images").mkdir()
    for row, name in zip(rows, names, strict=True):
        save_png(folder / "images" / name, dataset[row].image)
    if config.moving == "masked":
        masks = [f"masks/{name}{'.png' * is_colmap}" for name in names]
        (folder / "masks").mkdir()
        for row, mask in zip(rows, masks, strict=True):
            is_out, own = moving_mask(run.frames[row], size), dataset[row].mask
            save_png(folder / mask, np.uint8(255) * ~(is_out if own is None else is_out | own))
    poses, (points, colors) = run.poses[rows], _cloud(run, config.max_points)
    if is_colmap:
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        save_colmap(model, run.camera, names, poses, points, colors)
    else:
        vertices = np.rec.fromarrays(points.T.astype(np.float32), names="x,y,z")
        write_ply(folder / POINTS_FILE, with_colors(vertices, colors / 255.0))
        files = [f"images/{name}" for name in names]
        save_transforms(folder / "transforms.json", run.camera, files, poses, POINTS_FILE, masks)


def _frustums(run: FinishedRun, path: Path) -> None:
    """Write a pyramid for every frame in the colour of its status; the path breaks where the camera was lost."""
    colors = np.array([rgb(STATUS_COLORS.get(frame["status"], OURS)) for frame in run.frames])
    is_joined = run.is_placed[1:] & run.is_placed[:-1]
    save_frustums(path, run.camera, run.poses, colors, is_joined, rgb(OURS))


def _cloud(run: FinishedRun, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample at most `max_points` points (p, 3) and colours (p, 3), uint8, of the dense cloud; always the same ones."""
    columns = read_vertices(run.folder / POINTS_FILE)
    rows = np.sort(np.random.default_rng(0).permutation(len(columns["x"]))[:max_points])
    points = np.stack([columns[name][rows] for name in "xyz"], 1).astype(np.float64)
    return points, np.stack([columns[name][rows] for name in ("red", "green", "blue")], 1)


def factor_of(run: FinishedRun, length: Sequence[float]) -> float:
    """Compute the factor that gives the distance between two cameras its known length.

    `length` is two frames, numbered as `index` in frames.jsonl, and the metres between their camera centres. Raises
    ValueError for anything else, for a lost frame, and for two cameras at one place.
    """
    if len(length) != 3 or not math.isfinite(length[2]) or length[2] <= 0 or any(n != int(n) for n in length[:2]):
        raise ValueError(f"length must be [frame,frame,metres], two numbers of frames and a length, got {[*length]}")
    centers = []
    for index in map(int, length[:2]):
        found = [row for row, frame in enumerate(run.frames) if frame["index"] == index]
        if not found or run.frames[found[0]]["status"] in UNPLACED:
            why = "is lost, so its pose is a guess" if found else "is none of the run's"
            raise ValueError(f"length={[*length]}: frame {index} {why}: take another one (index in frames.jsonl)")
        centers.append(run.poses[found[0]][:3, 3])
    distance = float(np.linalg.norm(centers[1] - centers[0]))
    if distance < SHORTEST:
        raise ValueError(f"length={[*length]}: these two cameras are at one place: take two that are far apart")
    return length[2] / distance


def to_export(run: FinishedRun, factor: float | None, up: str) -> Sim3 | None:
    """Return the similarity from a run's world to that of an export; None if the run's own stays.

    With z up, x is the path's longest direction, as in `view_from_above`. The origin stays.
    """
    if factor is None and up == "run":
        return None
    rotation = np.eye(3)
    if up == "z":
        poses = run.poses[run.is_placed] if run.is_placed.any() else run.poses[:1]
        normals = np.asarray(run.map.gaussians.normals)[np.asarray(run.map.gaussians.valid)]
        rotation = view_from_above(poses, normals, measured_up(run))
    return Sim3(1.0 if factor is None else factor, rotation, np.zeros(3))


def measured_up(run: FinishedRun) -> np.ndarray | None:
    """Return up in a run's world, (3,), by what told its scale (floor, positions, inertial unit).

    It is known by one frame; None where that has no pose, and without such a source.
    """
    *up, index = (run.metrics.get(key) for key in UP_KEYS)
    rows = [row for row in np.flatnonzero(run.is_placed) if run.frames[row]["index"] == index]
    return run.poses[rows[0], :3, :3] @ up if rows else None


def write_moved(run: FinishedRun, folder: Path, T_export_map: Sim3) -> FinishedRun:
    """Write trajectories, map.npz, clouds, splats and the similarity into an existing `folder`; return the run there.

    Files that the run lacks are left out; truth and features stay.
    """
    is_turned = not np.array_equal(T_export_map.rotation, np.eye(3))
    for name in TRAJECTORIES:
        if (run.folder / name).is_file():
            times, poses = load_trajectory_tum(run.folder / name)
            save_trajectory_tum(folder / name, times, T_export_map.apply_to_poses(poses))
    poses, moved = T_export_map.apply_to_poses(run.poses), transformed(run.map, **vars(T_export_map))
    save_map(folder / "map.npz", moved)
    for name in CLOUDS:
        if (run.folder / name).is_file():
            transform_ply(run.folder / name, folder / name, T_export_map, "z is up" if is_turned else "")
    of = run.folder.resolve().name
    write_json(folder / MOVED_FILE, {"T_export_map": T_export_map.as_matrix().tolist(), "of": of})
    if T_export_map.scale != 1:
        write_json(folder / "scale.json", {"factor": T_export_map.scale, "of": of})
    return replace(run, folder=folder, poses=poses, map=moved)
