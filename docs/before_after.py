"""Draws docs/before_after.png, the built-in apartment before and after mapping, from a finished run.

emgs run dataset=apartment dataset.size=[160,120] dataset.stride=2 prior.version=2 graph=default hydra.run.dir=walk
python docs/before_after.py walk
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from emgs_jax.config.configure import build, build_dataset, build_prior, compose
from emgs_jax.drawing.overview import fill_holes, paint_from_above
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.mapping.window_input import window_inputs
from emgs_jax.runs.finished_run import FinishedRun, read_run
from emgs_jax.runs.gathering import gather
from emgs_jax.runs.metrics import true_cloud
from emgs_jax.runs.repeat import repeat

TARGET = Path(__file__).with_name("before_after.png")
LOW, HIGH = 0.4, 1.7  # m above the floor: walls and furniture, no floor and no ceiling
CELL = 0.02  # m
OURS, TRUTH = "#e4572e", "#1b998b"
NUM_IMAGES = 7


class Panel(NamedTuple):
    """Points (n, 3) with colours and poses (m, 4, 4) in a frame of their own, and their errors in metrics.json."""

    title: str
    points: np.ndarray
    colors: np.ndarray
    poses: np.ndarray
    path_m: float
    points_m: float


def before(run: FinishedRun, dataset, prior, config) -> Panel:
    """What the prior says by itself."""
    views = (view for given in window_inputs(dataset, prior, build(config, "slam")) for view in given.raw)
    evaluation = build(config, "evaluation")
    cloud = gather(views, evaluation, keeps_points=False).cloud.averaged(evaluation.voxel_m)
    errors = run.metrics["raw_prior/trajectory/ate_sim3_m"], run.metrics["raw_prior/reconstruction/accuracy_m"]
    return Panel("Before: the predictions as they come", cloud.points, cloud.colors, run.raw, *errors)


def after(run: FinishedRun) -> Panel:
    """The dense points of the map."""
    rows = read_vertices(run.folder / "points.ply")
    points, colors = (np.stack([rows[name] for name in names], 1) for names in ("xyz", ("red", "green", "blue")))
    errors = run.metrics["trajectory/ate_sim3_m"], run.metrics["reconstruction/accuracy_m"]
    return Panel("After: the map", points.astype(np.float64), colors / 255.0, run.poses, *errors)


def draw(axes: Axes, panel: Panel, truth: np.ndarray, walls: np.ndarray) -> None:
    """What stands between floor and ceiling over the true walls (grey), both paths on it; placed by the path."""
    placed, _ = align_poses(panel.poses, truth, True)
    points = placed.apply(panel.points)
    for cloud, colors in ((walls, np.full_like(walls, 0.75)), (points, panel.colors)):
        is_seen = (cloud[:, 2] > LOW) & (cloud[:, 2] < HIGH)
        image, extent = paint_from_above(cloud[is_seen], colors[is_seen], CELL)
        axes.imshow(fill_holes(image), extent=extent, origin="lower", interpolation="nearest")
    axes.plot(*truth[:, :2, 3].T, color=TRUTH, linewidth=5, label="true path")
    axes.plot(*placed.apply(panel.poses[:, :3, 3])[:, :2].T, color=OURS, linewidth=1.5, label="estimated path")
    axes.plot([], [], color="0.75", linewidth=5, label="true walls and furniture")
    low, high = walls[:, :2].min(0) - 0.4, walls[:, :2].max(0) + 0.4
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    errors = f"path {100 * panel.path_m:.0f} cm off, points {100 * panel.points_m:.0f} cm off"
    axes.set_title(f"{panel.title}\n{errors}", fontsize=15)
    axes.axis("off")


def main(folder: Path) -> None:
    """Draw, and write the picture."""
    run = read_run(folder)
    config = compose(*repeat(run.provenance["config"]).words)
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    walls = true_cloud(dataset, build(config, "evaluation")).cloud.points
    figure = Figure(figsize=(14, 9.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = np.ravel(figure.subfigures(2, 1, height_ratios=(1, 4)))
    title = f"{len(dataset)} colour images of a walk through the built-in apartment; prior {prior.provenance.name}"
    top.suptitle(title, fontsize=15)
    rows = np.linspace(0, len(dataset), NUM_IMAGES, endpoint=False).astype(int)
    for axes, row in zip(top.subplots(1, NUM_IMAGES), rows, strict=True):
        axes.imshow(dataset[int(row)].image)
        axes.axis("off")
    for axes, panel in zip(bottom.subplots(1, 2), (before(run, dataset, prior, config), after(run)), strict=True):
        draw(axes, panel, run.truth, walls)
    bottom.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=13, frameon=False)
    figure.savefig(TARGET, dpi=100)
    Image.open(TARGET).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(TARGET, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
