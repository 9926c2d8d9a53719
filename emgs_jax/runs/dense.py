"""The map as points: densified from the poses of its frames, its centres, and their classes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.device.arrays import fetched, to_se3
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds
from emgs_jax.evaluation.reconstruction import EvaluationConfig, camera_cloud, own_voxel, posed
from emgs_jax.evaluation.rendering import Rendered
from emgs_jax.evaluation.segmentation import LabelledPoints, translate
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.gaussian_map import confirmed
from emgs_jax.mapping.records import UNPLACED
from emgs_jax.mapping.run import MappingRun, with_truth
from emgs_jax.ops.camera import Camera, nearest_pixel, project
from emgs_jax.render.densify import DenseView, DensifyConfig, densify
from emgs_jax.runs.labelling import LabelledMap
from emgs_jax.runs.moving import moving_mask, with_moving

_densify = eqx.filter_jit(densify)


@dataclass(frozen=True)
class DenseMap:
    """The map as points: one per pixel of every frame with a known pose, averaged in voxels."""

    cloud: PointCloud  # in the colours of the images
    labels: LabelledPoints | None = None  # class of each of its points; None without classes
    pictures: list[dict[str, Any]] = field(default_factory=list)  # of some views, as `draw_overview` takes them
    rendering: dict[str, float | int | None] = field(default_factory=dict)  # of all views; empty without truth


def dense_map(
    run: MappingRun,
    dataset: Dataset,
    config: DensifyConfig,
    evaluation: EvaluationConfig,
    labelled: LabelledMap | None = None,
    num_pictures: int = 4,
    own: Sequence[np.ndarray] | None = None,
) -> DenseMap:
    """Render the map from the pose of every frame that is not lost.

    Args:
        evaluation: its voxels average points (metres of the truth if that is known), and views are compared with the
            truth under it.
        labelled: `labelled_map` of the run, which classifies points.
        own: raw points of every frame, camera frame, (h, w, 3) in the prior's lengths, 0 for none; only for
            `densify.points=own`.
    """
    if config.points != "map" and own is None:
        raise ValueError(f"densify.points={config.points} takes the points of the frames: give own=")
    known = [row for row, record in enumerate(run.records) if record.status not in UNPLACED]
    shown = {known[int(i)] for i in np.linspace(0, len(known) - 1, num_pictures)} if known else set()
    pictures: list[dict[str, Any]] = []
    compares_classes = labelled is not None and bool(dataset.classes)
    rendered = Rendered(dataset, with_truth(run, run.poses), evaluation, compares_classes)

    def clouds() -> Iterator[PointCloud]:
        for row, view in zip(known, _drawn(run, known, config), strict=True):
            labels = found = None
            if labelled is not None and (row in shown or compares_classes):
                # At the border of the map the coverage is too low for a depth, but enough for a class.
                labels = np.full(view.covered.shape, -1)
                labels[view.covered] = labelled.classes_of(view.points[view.covered].astype(np.float64))
                found = translate(labels, labelled.classes, dataset.classes) if compares_classes else None
            depth = np.where(view.valid, view.depth, 0.0)
            if row in shown:
                image, title = with_moving(dataset[row].image, vars(run.records[row])), run.records[row].index
                picture = {"image": image, "title": f"frame {title}", "valid": view.valid, "labels": labels}
                pictures.append(picture | {"rendered_color": view.colors, "rendered_depth": depth})
            rendered.add(row, depth, view.colors, found)
            # A voxel's colour is the mean of all pixels that see it: those of near and frontal views are most of them.
            frame = dataset[row]
            image, is_out = frame.image, frame.mask
            stays = ~moving_mask(vars(run.records[row]), image.shape[1::-1])  # else what is behind has its colour
            stays &= True if is_out is None else ~is_out
            if config.points == "map":
                drawn, is_drawn = (view.points, view.normals, image / 255.0), view.valid & stays
                yield PointCloud(*(values[is_drawn].astype(np.float64) for values in drawn))
            else:
                points = run.records[row].scale * own[row]
                kept, normals = uncontradicted(points, view, run.camera, float(config.surface_depth))
                kept &= stays
                seen = posed(camera_cloud(points, kept, image, evaluation), run.poses[row])
                normals = np.where(normals[kept].any(-1, keepdims=True), normals[kept], seen.normals)
                yield PointCloud(seen.points, normals, seen.colors)

    cloud = fuse_clouds(clouds(), voxel_of(with_truth(run, run.poses), evaluation))
    points = cloud.points
    labels = None if labelled is None else LabelledPoints(points, labelled.classes_of(points), labelled.classes)
    return DenseMap(cloud, labels, pictures, rendered.metrics())


def uncontradicted(
    points: np.ndarray, view: DenseView, camera: Camera, surface_depth: float
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the points of a frame that the map does not contradict; also return the map's normals there.

    The mean of W depths of variance σ² and correlation ρ has the variance σ² (ρ + (1 - ρ) / W). If frames share errors,
    as in multi-view stereo, where they are matched with the same images, ρ is near 1. Then the mean is no more precise
    than any of them, and lacks what is smaller than a Gaussian. In that case the map decides which points are right,
    and the frame where they are (two gates, like geometric and photometric consistency in COLMAP, Schönberger et al.
    2016). Where the map shows nothing, as at the border of what few frames see, it contradicts nothing.

    Args:
        points: of the frame, camera frame, (h, w, 3) in the map's lengths; 0 for none. They need not lie on the rays of
            the camera.
        view: the map, rendered from the frame's pose, on the host.
        surface_depth: fraction of the map's depth by which a point may differ from it.

    Returns:
        Whether a point is kept (h, w), and normals (h, w, 3), world frame; 0 where the map shows nothing.
    """
    pixels, depth = project(camera, jnp.asarray(points, jnp.float32))
    index, is_inside, depth = jax.device_get((*nearest_pixel(pixels, depth.shape), depth))
    there = view.depth.ravel()[index]
    is_shown = is_inside & view.valid.ravel()[index]
    is_near = np.abs(depth - there) <= surface_depth * there
    normals = view.normals.reshape(-1, 3)[index]
    return (depth > 0) & (is_near | ~is_shown), np.where(is_shown[..., None], normals, 0.0)


def voxel_of(poses: tuple[np.ndarray, np.ndarray] | None, config: EvaluationConfig) -> float:
    """Compute a voxel's side in the map's lengths: `voxel_m`, of the truth if the map's unit is larger than a metre."""
    if poses is None:
        return config.voxel_m
    return min(config.voxel_m, own_voxel(align_poses(*poses, with_scale=True)[0], config))


def _drawn(run: MappingRun, rows: list[int], config: DensifyConfig) -> Iterator[DenseView]:
    gaussians, poses = confirmed(run.state.map), run.poses
    views = (_densify(gaussians, to_se3(poses[row]), run.camera, config) for row in rows)
    # The rendering is not used, so it is not fetched.
    return fetched(eqx.tree_at(lambda view: view.rendering, view, None) for view in views)


def center_cloud(run: MappingRun) -> PointCloud:
    """Return the means of the confirmed Gaussians, with normals and colours."""
    gaussians = jax.device_get(confirmed(run.state.map))
    rows = (gaussians.means, gaussians.normals, gaussians.colors)
    return PointCloud(*(values[gaussians.valid].astype(np.float64) for values in rows))
