"""A finished run in the formats of other programs: COLMAP, nerfstudio, cameras as a mesh."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.io.colmap import save_colmap
from emgs_jax.io.files import new_folder
from emgs_jax.io.frustums import save_frustums
from emgs_jax.io.nerfstudio import save_transforms
from emgs_jax.io.ply import with_colors, write_ply
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.ops.ranges import number
from emgs_jax.report.page_strip import OURS, STATUS_COLORS
from emgs_jax.report.recorded_run import RecordedRun
from emgs_jax.report.scaling import factor_of

POINTS_FILE = "points.ply"
FORMATS = {"colmap": "colmap", "nerfstudio": "nerfstudio", "frustums": "cameras.ply"}  # and what is written
IMAGE_FORMATS = {"colmap", "nerfstudio"}


@dataclass(frozen=True)
class ExportConfig:
    """Settings of an export of a run: formats, size and scale.

    Args:
        formats: names of FORMATS.
        max_points: of the dense cloud, drawn evenly.
        scale: factor on all lengths; None = 1.
        length: instead of it two frames and the metres between their cameras, see `factor_of`.
        images: as `used` in the run, or in the `original` size on disk; either way without distortion.
    """

    formats: Sequence[str]
    max_points: int = number(low=1, high=2**26)
    scale: float | None = number(low=1e-6, high=1e6)
    length: Sequence[float] | None = number(low=0, high=2**31)
    images: str = field(default="used", metadata={"choices": ("used", "original")})


def export(run: RecordedRun, folder: Path, config: ExportConfig, dataset: ReadableFrames | None) -> list[Path]:
    """Write a run into `folder`, which is there, in the run's unit; returns what was written.

    Args:
        run: whose poses and points are written.
        folder: to write into.
        config: what to write.
        dataset: the images of the run; None where they are gone.

    Raises:
        ValueError: an unknown format, one that needs images or points which are not there, or something stands where
            an export would; then nothing is written.
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
            write = _colmap if name == "colmap" else _nerfstudio
            write(run, folder / FORMATS[name], dataset, config.max_points)
    return [folder / FORMATS[name] for name in config.formats]


def find_factor(run: RecordedRun, config: ExportConfig) -> float | None:
    """Return the factor on all lengths of a run, from `scale` or `length`; None if neither is given."""
    if config.length is None:
        return config.scale
    if config.scale is not None:
        raise ValueError("scale= and length= both say how long things are: give one of them")
    return factor_of(run, config.length)


def _colmap(run: RecordedRun, folder: Path, dataset: ReadableFrames, max_points: int) -> None:
    """A project folder: images/ and sparse/0/."""
    with new_folder(folder) as new:
        names = _write_images(new / "images", run, dataset)
        model = new / "sparse" / "0"
        model.mkdir(parents=True)
        save_colmap(model, run.camera, names, run.poses[run.is_placed], *_cloud(run, max_points))


def _nerfstudio(run: RecordedRun, folder: Path, dataset: ReadableFrames, max_points: int) -> None:
    """images/, points.ply and transforms.json."""
    with new_folder(folder) as new:
        names = _write_images(new / "images", run, dataset)
        points, colors = _cloud(run, max_points)
        vertices = np.rec.fromarrays(points.T.astype(np.float32), names="x,y,z")
        write_ply(new / POINTS_FILE, with_colors(vertices, colors / 255.0))
        files = [f"images/{name}" for name in names]
        save_transforms(new / "transforms.json", run.camera, files, run.poses[run.is_placed], POINTS_FILE)


def _frustums(run: RecordedRun, path: Path) -> None:
    """A pyramid for every frame in the colour of its status; the path is not drawn where the camera was lost."""
    colors = np.array([to_rgb(STATUS_COLORS.get(frame["status"], OURS)) for frame in run.frames])
    is_joined = run.is_placed[1:] & run.is_placed[:-1]
    save_frustums(path, run.camera, run.poses, colors, is_joined, np.array(to_rgb(OURS)))


def _write_images(folder: Path, run: RecordedRun, dataset: ReadableFrames) -> list[str]:
    """Write the images of the placed frames, undistorted and in the run's size; returns their names.

    A name is the frame's number and has one dot: 3DGS cuts at the first one.
    """
    folder.mkdir()
    names = []
    for row in np.flatnonzero(run.is_placed):
        names.append(f"{run.frames[row]['index']:06d}.png")
        if not cv2.imwrite(str(folder / names[-1]), cv2.cvtColor(dataset[row].image, cv2.COLOR_RGB2BGR)):
            raise OSError(f"{folder / names[-1]} cannot be written: is the disk full?")
    return names


def _cloud(run: RecordedRun, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (p, 3) and colours (p, 3), uint8, of the dense cloud, at most so many; the same ones every time."""
    columns = read_vertices(run.folder / POINTS_FILE)
    count = len(columns["x"])
    rows = np.sort(np.random.default_rng(0).permutation(count)[:max_points])
    points, colors = (
        np.stack([columns[name][rows] for name in names], 1) for names in (("x", "y", "z"), ("red", "green", "blue"))
    )
    return points.astype(np.float64), colors
