"""Draws docs/pipeline.jpg, from images to a map, from a finished run of the built-in room.

emgs run hydra.run.dir=room
python docs/pipeline.py room
"""

import sys
from itertools import islice
from pathlib import Path

import equinox as eqx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from emgs_jax.config.configure import build, build_dataset, build_prior, compose
from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.layers import closed
from emgs_jax.drawing.overview import fill_holes, paint_from_above
from emgs_jax.gaussian_map import confirmed
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.mapping.window_input import window_inputs
from emgs_jax.render.composite import render
from emgs_jax.runs.finished_run import FinishedRun, read_run, render_config
from emgs_jax.runs.repeat import repeat

TARGET, FRAME = Path(__file__).with_name("pipeline.jpg"), 20
CELL, HIGH = 0.02, 1.7  # m
STAGES = (
    ("Images", "a window of frames", "data/"),
    ("Prior", "depth and poses of the window", "prior/"),
    ("Localization", "coarse, then ICP: points from above", "localization.py, registration/"),
    ("EM and refinement", "points move Gaussians, or make new ones", "em.py, refinement.py"),
    ("Map", "Gaussians of all frames, from above", "gaussian_map.py"),
)


def from_above(points: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Image (h, w, 4) of points (n, 3) below `HIGH`; z is up."""
    is_below = points[:, 2] < HIGH
    return fill_holes(paint_from_above(points[is_below], colors[is_below], CELL)[0])[::-1]


def panels(run: FinishedRun) -> list[np.ndarray]:
    """What each stage is given or makes."""
    config = compose(*repeat(run.provenance["config"]).words)
    dataset = build_dataset(config)
    inputs = window_inputs(dataset, build_prior(config, dataset), build(config, "slam"))
    raw = next(islice((view for given in inputs for view in given.raw), FRAME, None))
    map = closed(confirmed(run.map))
    drawn = eqx.filter_jit(render)(map, map.colors, to_se3(run.poses[FRAME]), run.camera, render_config(run))
    rows = read_vertices(run.folder / "points.ply")
    cloud, colors = (np.stack([rows[name] for name in names], 1) for names in ("xyz", ("red", "green", "blue")))
    placed = raw.points[raw.mask] @ run.poses[FRAME][:3, :3].T + run.poses[FRAME][:3, 3]
    own = from_above(placed, raw.image[raw.mask] / 255.0)
    return [dataset[FRAME].image, raw.points[..., 2], own, np.asarray(drawn.values), from_above(cloud, colors / 255.0)]


def draw(axes: Axes, picture: np.ndarray, words: tuple[str, str, str]) -> None:
    """One stage: its picture, its name, what it does and where it stands."""
    axes.imshow(np.clip(picture, 0, 1) if picture.ndim == 3 and picture.dtype != np.uint8 else picture, cmap="viridis")
    axes.set_axis_off()
    name, does, where = words
    axes.set_title(name, fontsize=13, fontweight="bold")
    axes.text(0.5, -0.06, f"{does}\n{where}", transform=axes.transAxes, ha="center", va="top", fontsize=9)


def main(folder: str) -> None:
    """Draw the figure of the run in a folder."""
    figure = Figure(figsize=(16, 3.6), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    columns = figure.subplots(1, len(STAGES), gridspec_kw={"wspace": 0.25, "left": 0.02, "right": 0.98})
    for axes, picture, words in zip(columns, panels(read_run(Path(folder))), STAGES, strict=True):
        draw(axes, picture, words)
        if words is not STAGES[-1]:
            axes.annotate("", (1.2, 0.5), (1.05, 0.5), "axes fraction", arrowprops={"arrowstyle": "->", "lw": 2})
    figure.canvas.draw()
    Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]).save(TARGET, quality=85)


if __name__ == "__main__":
    main(sys.argv[1])
