"""The map as points: what is rendered of it from the poses of its frames, its centres, and their classes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds
from emgs_jax.evaluation.reconstruction import EvaluationConfig, own_voxel
from emgs_jax.evaluation.rendering import Rendered
from emgs_jax.evaluation.segmentation import LabelledPoints, translate
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.gaussian_map import confirmed
from emgs_jax.render.densify import DenseView, DensifyConfig, densify
from emgs_jax.running.convert import to_se3
from emgs_jax.running.executables import stored
from emgs_jax.running.labelling import LabelledMap
from emgs_jax.running.record import MappingRun, with_truth

_densify = stored(densify)


@dataclass(frozen=True)
class DenseMap:
    """The map as points.

    Args:
        cloud: a point per pixel of every frame whose pose is known, averaged per voxel, in the colours of the images.
        labels: class of each of its points; None without classes.
        pictures: what the overview shows of some frames.
        rendering: `rendering_metrics` of the views that the cloud is made from; empty without truth.
    """

    cloud: PointCloud
    labels: LabelledPoints | None = None
    pictures: list[dict[str, Any]] = field(default_factory=list)
    rendering: dict[str, float | int | None] = field(default_factory=dict)


def dense_map(
    run: MappingRun,
    dataset: Dataset,
    config: DensifyConfig,
    evaluation: EvaluationConfig,
    labelled: LabelledMap | None = None,
    num_pictures: int = 4,
    depths: Sequence[np.ndarray] | None = None,
) -> DenseMap:
    """Render the map from the pose of every frame that is not lost.

    Args:
        run: finished.
        dataset: for the images, and the truth.
        config: what becomes a point.
        evaluation: points of one of its voxels, of the truth where that is known, are averaged, and views are
            compared with the truth under it.
        labelled: `labelled_map` of the run, which says the class of each point.
        num_pictures: frames that are shown, evenly spread.
        depths: what the prior says of every frame, camera-space z (h, w) in its own lengths, 0 where it says none; for
            `densify.points=own` only.
    """
    if config.points == "own" and depths is None:
        raise ValueError("densify.points=own puts points at the depths of the frames: give depths=")
    known = [row for row, record in enumerate(run.records) if record.status != "lost"]
    shown = {known[int(i)] for i in np.linspace(0, len(known) - 1, num_pictures)} if known else set()
    pictures: list[dict[str, Any]] = []
    compares_classes = labelled is not None and bool(dataset.classes)
    rendered = Rendered(dataset, with_truth(run, run.poses), evaluation, compares_classes)

    def clouds() -> Iterator[PointCloud]:
        for row, view in zip(known, _drawn_ahead(run, known, config), strict=True):
            is_shown = row in shown
            labels = _label_image(view, labelled) if is_shown or compares_classes else None
            if is_shown:
                pictures.append(_picture(run, dataset, row, view) | ({} if labels is None else {"labels": labels}))
            found = translate(labels, labelled.classes, dataset.classes) if compares_classes else None
            rendered.add(row, np.where(view.valid, view.depth, 0.0), view.colors, found)
            points, valid = view.points, view.valid
            if config.points == "own":
                scale = run.records[row].scale  # the map's unit is that of the first frames
                own = depths[row] * (1.0 if scale is None else scale)
                points, valid = at_own_depth(view, own, run.poses[row][:3, 3], float(config.surface_depth))
            # A voxel's colour is the mean of all pixels that see it: those of near and frontal views are most of them.
            seen = dataset[row].image[valid] / 255.0
            yield PointCloud(*(rows[valid].astype(np.float64) for rows in (points, view.normals)), seen)

    cloud = fuse_clouds(clouds(), _voxel(with_truth(run, run.poses), evaluation))
    points = cloud.points
    labels = None if labelled is None else LabelledPoints(points, labelled.classes_of(points), labelled.classes)
    return DenseMap(cloud, labels, pictures, rendered.metrics())


def at_own_depth(
    view: DenseView, own: np.ndarray, center: np.ndarray, surface_depth: float
) -> tuple[np.ndarray, np.ndarray]:
    """The points of a view at the depth of its own frame, valid where map and frame show one surface.

    The mean of W depths of variance σ² whose errors have the correlation ρ has the variance σ² (ρ + (1 - ρ) / W). Where
    frames err alike, as those of multi-view stereo do, which are matched with the same images, ρ is near 1: the mean is
    no more precise than any of them, and what is smaller than a Gaussian is missing in it. There the map says which
    depths are right, and the frame where: x = c + (z / z_map) (x_map - c) where |z - z_map| <= `surface_depth` z_map,
    and no point where the frame says something else, or nothing (two gates, as in the geometric and photometric
    consistency of COLMAP, Schönberger et al. 2016).

    Args:
        view: drawn, on the host.
        own: camera-space z (h, w) of the frame in the map's lengths; 0 where there is none.
        center: of the camera, world frame.
        surface_depth: fraction of the depth, as of `DensifyConfig`.

    Returns:
        Points (h, w, 3), world frame, and which are valid; the map's where they are not.
    """
    valid = view.valid & (own > 0) & (np.abs(own - view.depth) <= surface_depth * view.depth)
    ratio = np.where(valid, own, 1.0) / np.where(valid, view.depth, 1.0)
    return center + ratio[..., None] * (view.points - center), valid


def _voxel(poses: tuple[np.ndarray, np.ndarray] | None, config: EvaluationConfig) -> float:
    """Side of a voxel in the map's lengths: `voxel_m`, of the truth where the map's unit is larger than a metre."""
    if poses is None:
        return config.voxel_m
    return min(config.voxel_m, own_voxel(align_poses(*poses, with_scale=True)[0], config))


def _drawn_ahead(run: MappingRun, rows: list[int], config: DensifyConfig) -> Iterator[DenseView]:
    """The views of frames on the host; the next is being drawn while one is looked at."""
    pending: DenseView | None = None
    gaussians, poses = confirmed(run.state.map), run.poses
    for row in rows:
        view = _densify(gaussians, to_se3(poses[row]), run.camera, config)
        drawing = eqx.tree_at(lambda view: view.rendering, view, None)  # nobody looks at it, so it is not fetched
        if pending is not None:
            yield jax.device_get(pending)
        pending = drawing
    if pending is not None:
        yield jax.device_get(pending)


def center_cloud(run: MappingRun) -> PointCloud:
    """The confirmed Gaussians' means with their normals and colours."""
    gaussians = jax.device_get(confirmed(run.state.map))
    rows = (gaussians.means, gaussians.normals, gaussians.colors)
    return PointCloud(*(values[gaussians.valid].astype(np.float64) for values in rows))


def _picture(run: MappingRun, dataset: Dataset, row: int, view: Any) -> dict[str, Any]:
    return {
        "image": dataset[row].image,
        "rendered_color": view.colors,
        "rendered_depth": np.where(view.valid, view.depth, 0.0),
        "valid": view.valid,
        "title": f"frame {run.records[row].index}",
    }


def _label_image(view: Any, labelled: LabelledMap | None) -> np.ndarray | None:
    """Class of each pixel (h, w) that anything covers, -1 = none; None without classes.

    At the rim of what was seen the coverage is too little for a depth, and enough for a class.
    """
    if labelled is None:
        return None
    labels = np.full(view.covered.shape, -1)
    labels[view.covered] = labelled.classes_of(view.points[view.covered].astype(np.float64))
    return labels
