"""One picture of a run: the map from above with both paths, and renderings beside camera images."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from emgs_jax.drawing.colors import OURS, PATHS, class_colors, save_figure
from emgs_jax.evaluation.clouds import PointCloud
from emgs_jax.geometry import rotated
from emgs_jax.scale.up import up_of_cameras, up_of_surfaces

MAX_NORMALS = 20_000  # of which up is found
_INK, _PAPER = "#333333", "#e3e6ea"


@dataclass(frozen=True)
class Paths:
    """Camera trajectories, (n, 4, 4) T_world_camera each, all in one frame; None for a path that does not exist."""

    estimate: np.ndarray
    is_placed: np.ndarray  # (n,), False where the camera was lost and its pose is a placeholder
    truth: np.ndarray | None = None  # aligned with the estimate; NaN where unknown
    online: np.ndarray | None = None  # as first estimated, before the back end moved poses
    loops: tuple[tuple[int, int], ...] = ()  # rows of the frames that loop closures join
    unit: str = "m"


def draw_overview(
    path: str | os.PathLike,
    cloud: PointCloud,
    paths: Paths,
    frames: Sequence[Mapping[str, Any]],
    title: str,
    classes: Sequence[str] = (),
    features: PointCloud | None = None,
) -> None:
    """Draw the picture and write it as PNG.

    Args:
        frames: about four, each with `image` uint8 (h, w, 3), `rendered_color` float (h, w, 3), `rendered_depth`
            float (h, w) in the unit of the paths, `valid` bool (h, w), where it is known, `title`, and with classes
            `labels`, int (h, w), -1 = none.
        features: points in the colours of their features, drawn from above below the map; None without features.
    """
    figure = Figure(figsize=(16, max(6.0, 0.8 + 2.05 * len(frames))), facecolor="white", layout="constrained")
    figure.suptitle(title, fontsize=13, color=_INK)
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.05)) if frames else (figure, None)
    axes = left.subplots(1 if features is None else 2, squeeze=False)[:, 0]
    _draw_map(axes[0], cloud, paths)
    if features is not None:
        rotation = view_from_above(paths.estimate, cloud.normals)
        _paint(axes[1], features, rotation, paths.estimate[:, :3, 3] @ rotation[2], (40, 250))
        _bare(axes[1])
        axes[1].set_title("features of the map, their main directions as colours", fontsize=11, color=_INK)
    if right is not None:
        grid = right.subplots(len(frames), 4 if classes else 3, squeeze=False)
        _draw_frames(grid[:, [0, 1, -1]], frames, paths.unit)
        if classes:
            _draw_labels(grid[:, 2], frames, classes)
    save_figure(path, figure)


def view_from_above(poses: np.ndarray, normals: np.ndarray | None = None, up: np.ndarray | None = None) -> np.ndarray:
    """Return world → picture (3, 3) with rows right, forward, up.

    Args:
        poses: of cameras that are held level, but may look down: see `up_of_cameras`.
        normals: of the map, (n, 3) of any length, 0 where unknown; floors and walls improve up (`up_of_surfaces`).
        up: unit vector (3,), if it is known otherwise.
    """
    is_known, up = up is not None, up_of_cameras(poses[:, :3, :3]) if up is None else up
    if normals is not None and not is_known:
        some = normals[:: len(normals) // MAX_NORMALS + 1].astype(np.float64)
        lengths = np.linalg.norm(np.nan_to_num(some), axis=1)
        up = up_of_surfaces(up, some[lengths > 0] / lengths[lengths > 0, None], np.ones(np.sum(lengths > 0)))
    centers = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    flat = centers - np.outer(centers @ up, up)
    # The path's longest direction points right; a camera at rest looks up the picture.
    direction = np.linalg.svd(flat, full_matrices=True)[2][0] if len(poses) > 2 else poses[0, :3, 0]
    direction = direction if np.abs(flat).max() > 1e-3 else poses[0, :3, 0]
    direction = direction * np.where(direction @ poses[0, :3, 0] < 0, -1.0, 1.0)
    right = direction - (direction @ up) * up
    right /= max(np.linalg.norm(right), 1e-9)
    return np.stack([right, np.cross(up, right), up])


def below_ceiling(heights: np.ndarray, camera_heights: np.ndarray) -> np.ndarray:
    """Mask what to show from above: nothing higher than the camera, unless that hides most of the map."""
    visible = heights <= camera_heights.max() + 0.1
    return visible if visible.mean() > 0.2 else np.ones_like(visible)


def paint_from_above(points: np.ndarray, colors: np.ndarray, cell: float) -> tuple[np.ndarray, tuple[float, ...]]:
    """Paint points (x, y right and up, z height) into cells [m]; each cell shows its highest point.

    Returns RGBA (h, w, 4), transparent in empty cells, and the extent (left, right, bottom, top) in metres.
    """
    low = np.floor(points[:, :2].min(0) / cell)
    index = (np.floor(points[:, :2] / cell) - low).astype(np.int64)
    width, height = index.max(0) + 1
    image = np.zeros((height, width, 4))
    order = np.argsort(points[:, 2], kind="stable")  # for repeated indices the last assignment wins
    image[index[order, 1], index[order, 0], :3] = colors[order]
    image[index[order, 1], index[order, 0], 3] = 1.0
    left, bottom = low * cell
    return image, (left, left + width * cell, bottom, bottom + height * cell)


def fill_holes(image: np.ndarray) -> np.ndarray:
    """Fill empty cells of an RGBA picture (h, w, 4) among painted ones with their mean colour; twice."""
    for _ in range(2):
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
        h, w = image.shape[:2]
        around = sum(padded[row : row + h, column : column + w] for row in range(3) for column in range(3))
        is_hole = (image[..., 3] == 0) & (around[..., 3] >= 3.5)
        image = np.where(is_hole[..., None], around / np.maximum(around[..., 3:], 1.0), image)
    return image


def seen_from_above(
    points: np.ndarray, colors: np.ndarray, camera_heights: np.ndarray, cells: tuple[int, int] = (100, 700)
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Paint finite points, at least one (x, y right and up, z height); return as `paint_from_above` does.

    Points above the cameras and far points are left out. The longer side of the points has `cells` cells.
    """
    seen = below_ceiling(points[:, 2], camera_heights)
    # Far flying points must not shrink the room to a dot.
    low, high = np.percentile(points[seen, :2], [0.5, 99.5], axis=0)
    margin = 0.1 * (high - low) + 0.05
    seen &= ((points[:, :2] >= low - margin) & (points[:, :2] <= high + margin)).all(1)
    size = float(np.max(high - low + 2 * margin))
    cell = size / np.clip(1.2 * np.sqrt(seen.sum()), *cells)
    image, extent = paint_from_above(points[seen], colors[seen], cell)
    return fill_holes(image), extent


def _draw_map(axes: Axes, cloud: PointCloud, paths: Paths) -> None:
    rotation = view_from_above(paths.estimate, cloud.normals)
    path = paths.estimate[:, :3, 3] @ rotation.T
    count = _paint(axes, cloud, rotation, path[:, 2])
    for name, poses, label, width in (
        ("truth", paths.truth, "true path, where it fits best", 5.0),
        ("online", paths.online, "as it was placed", 1.6),
    ):
        if poses is not None:
            _draw_path(axes, poses[:, :3, 3] @ rotation.T, PATHS[name].paper, label, width)
    # Thinner than the true path, outline included, so that both show where they overlap.
    _draw_path(axes, np.where(paths.is_placed[:, None], path, np.nan), OURS, "estimated path", 1.6)
    if paths.loops:
        ends = path[np.array(paths.loops)]
        lines = axes.plot(*ends[..., :2].T, color=PATHS["loops"].paper, linewidth=1.6, zorder=3)
        lines[0].set_label(f"{len(ends)} loops")
    axes.set_facecolor(_PAPER)
    axes.set_xlabel({"m": "metres"}.get(paths.unit, paths.unit), color=_INK)
    axes.tick_params(colors=_INK, labelsize=9)
    axes.grid(color="white", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[:].set_visible(False)
    axes.set_title(f"map from above, {count:,} points", fontsize=11, color=_INK)
    axes.legend(loc="upper right", fontsize=10, framealpha=0.9)
    _draw_scale_bar(axes, paths.unit)


def _paint(axes: Axes, cloud: PointCloud, rotation: np.ndarray, heights: np.ndarray, *cells: tuple[int, int]) -> int:
    """Paint the finite points of a cloud with `seen_from_above`; return their number."""
    finite = np.isfinite(cloud.points).all(1)
    if finite.any():
        points, colors = rotated(cloud.points[finite], rotation), cloud.colors[finite].clip(0.0, 1.0)
        image, extent = seen_from_above(points, colors, heights, *cells)
        axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=1)
    axes.set_aspect("equal", adjustable="datalim")
    return int(finite.sum())


def _draw_path(axes: Axes, path: np.ndarray, color: str, label: str, width: float) -> None:
    """Draw a path (n, 3) as a line, broken where unknown, with a disc at the start and a square at the end."""
    outline = [withStroke(linewidth=width + 1.6, foreground="white")]
    axes.plot(path[:, 0], path[:, 1], color=color, linewidth=width, label=label, path_effects=outline)
    known = path[np.isfinite(path).all(1)]
    for marker, end in (("o", known[:1]), ("s", known[-1:])):
        axes.plot(*end[:, :2].T, marker=marker, markersize=7, color=color, markeredgecolor="white", linestyle="none")


def _draw_scale_bar(axes: Axes, unit: str) -> None:
    left, right = axes.get_xlim()
    length = 10.0 ** np.floor(np.log10(max(right - left, 1e-6) / 4))
    length *= max(step for step in (1, 2, 5) if step * length <= (right - left) / 4)
    transform = axes.get_xaxis_transform()  # x in metres, y in shares of the axes
    start = left + 0.04 * (right - left)
    look = {"color": _INK, "linewidth": 4, "transform": transform, "solid_capstyle": "butt"}
    axes.plot([start, start + length], [0.04, 0.04], **look)
    text = axes.text(start + length / 2, 0.055, f"{length:g} {unit}", transform=transform, ha="center", color=_INK)
    text.set_path_effects([withStroke(linewidth=3, foreground="white")])


def _draw_frames(grid: np.ndarray, frames: Sequence[Mapping[str, Any]], unit: str) -> None:
    depths = []
    for frame in frames:
        depth = np.asarray(frame["rendered_depth"], np.float64)
        depths.append(np.ma.masked_where(~(np.asarray(frame["valid"]) & np.isfinite(depth)), depth))
    seen = np.concatenate([depth.compressed() for depth in depths])
    near, far = np.percentile(seen[seen > 0], [1, 99]) if (seen > 0).any() else (0.0, 1.0)
    mappable = None
    for row, frame, depth in zip(grid, frames, depths, strict=True):
        row[0].imshow(np.asarray(frame["image"]))
        row[1].imshow(np.nan_to_num(np.asarray(frame["rendered_color"], np.float64)).clip(0.0, 1.0))
        mappable = row[2].imshow(depth, cmap="turbo", vmin=near, vmax=far)
        row[2].set_facecolor("#dddddd")
        row[0].set_ylabel(str(frame["title"]), fontsize=10, color=_INK)
        for axes in row:
            _bare(axes)
    for axes, title in zip(grid[0], ("input", "rendered colour", "rendered depth"), strict=True):
        axes.set_title(title, fontsize=11, color=_INK)
    bar = grid[0, 0].figure.colorbar(mappable, ax=grid[:, 2].tolist(), shrink=0.6, aspect=30, label=f"depth [{unit}]")
    bar.outline.set_visible(False)


def _draw_labels(column: np.ndarray, frames: Sequence[Mapping[str, Any]], classes: Sequence[str]) -> None:
    """Draw the classes of some frames, and a legend of visible ones."""
    colors = class_colors(len(classes))
    for axes, frame in zip(column, frames, strict=True):
        labels = np.asarray(frame["labels"])
        axes.imshow(np.where((labels >= 0)[..., None], colors[labels], 0.867), interpolation="nearest")
        _bare(axes)
    column[0].set_title("labels", fontsize=11, color=_INK)
    seen = sorted({int(label) for frame in frames for label in np.unique(frame["labels"]) if label >= 0})
    handles = [Patch(color=colors[label], label=classes[label]) for label in seen]
    column[-1].figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9, frameon=False)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
