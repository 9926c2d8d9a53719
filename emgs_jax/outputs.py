"""The files of a run: trajectory, map, Gaussians, densified points, mesh and the overview."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax import export
from emgs_jax.data.base import Dataset
from emgs_jax.data.convert import to_se3
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds
from emgs_jax.evaluation.overview import draw_overview
from emgs_jax.evaluation.segmentation import LabelledPoints, transfer_labels
from emgs_jax.mapping_run import MappingRun
from emgs_jax.prior.base import Prior
from emgs_jax.render.densify import DensifyConfig, densify
from emgs_jax.semantics import classify

_densify = eqx.filter_jit(densify)


@dataclass(frozen=True)
class DenseMap:
    """The map as points.

    Args:
        cloud: a point per pixel of every frame whose pose is known, averaged per voxel.
        labels: class of each of its points; None without classes.
        pictures: what the overview shows of some frames.
    """

    cloud: PointCloud
    labels: LabelledPoints | None = None
    pictures: list[dict[str, Any]] = field(default_factory=list)


def save_progress(folder: Path, run: MappingRun) -> None:
    """Write trajectory.txt and map.npz of the frames so far; nothing before there is a map."""
    if run.state is not None:
        export.save_trajectory_tum(
            folder / "trajectory.txt", [record.timestamp for record in run.records], np.stack(run.poses)
        )
        export.save_map_npz(folder / "map.npz", run.state.map)


def dense_map(
    run: MappingRun,
    dataset: Dataset,
    config: DensifyConfig,
    voxel: float,
    centers: LabelledPoints | None = None,
    num_pictures: int = 4,
) -> DenseMap:
    """Render the map from the pose of every frame that is not lost.

    Args:
        run: finished.
        dataset: for the images in the pictures.
        config: what becomes a point.
        voxel: m; points of one voxel are averaged.
        centers: of the `label_centers`, whose nearest one labels a point.
        num_pictures: frames that are shown, evenly spread.
    """
    known = [row for row, record in enumerate(run.records) if record.status != "lost"]
    shown = {known[int(i)] for i in np.linspace(0, len(known) - 1, num_pictures)} if known else set()
    pictures: list[dict[str, Any]] = []

    def clouds() -> Iterator[PointCloud]:
        for row in known:
            view = jax.device_get(_densify(run.state.map.gaussians, to_se3(run.poses[row]), run.camera, config))
            if row in shown:
                pictures.append(_picture(run, dataset, row, view) | _label_image(view, centers))
            yield PointCloud(
                *(rows[view.valid].astype(np.float64) for rows in (view.points, view.normals, view.colors))
            )

    cloud = fuse_clouds(clouds(), voxel)
    return DenseMap(cloud, None if centers is None else _labelled(centers, cloud.points), pictures)


def center_cloud(run: MappingRun) -> PointCloud:
    """The Gaussians' means with their normals and colours."""
    gaussians = jax.device_get(run.state.map.gaussians)
    rows = (gaussians.means, gaussians.normals, gaussians.colors)
    return PointCloud(*(values[gaussians.valid].astype(np.float64) for values in rows))


def label_centers(run: MappingRun, prior: Prior) -> LabelledPoints | None:
    """The Gaussians' means with the class whose text is closest to their feature; None without features or classes.

    Raises:
        ValueError: the embeddings' width differs from the features'.
    """
    gaussians = run.state.map.gaussians
    if not prior.feature_names or not gaussians.features.shape[-1]:
        return None
    labels = np.asarray(classify(gaussians, jnp.asarray(prior.text_features, jnp.float32)))
    valid = np.asarray(gaussians.valid)
    return LabelledPoints(np.asarray(gaussians.means, np.float64)[valid], labels[valid], tuple(prior.feature_names))


def save_outputs(folder: Path, run: MappingRun, dense: DenseMap, config: DensifyConfig, title: str) -> list[str]:
    """Write the files that show the map; returns what could not be made, and why."""
    gaussians = jax.device_get(run.state.map.gaussians)
    valid = gaussians.valid
    # As drawn: the covariances are those that close the surface.
    covs = gaussians.covs[valid] * float(config.render.covariance_scale)
    rest = gaussians.colors[valid], float(config.render.opacity), gaussians.normals[valid]
    export.save_gaussians_ply(folder / "map.ply", gaussians.means[valid], covs, *rest)
    labels = () if dense.labels is None else (dense.labels.labels, dense.labels.classes)
    export.save_points_ply(folder / "points.ply", dense.cloud.points, dense.cloud.normals, dense.cloud.colors, *labels)
    centers = center_cloud(run)
    no_mesh = export.save_mesh_ply(folder / "mesh.ply", centers.points, centers.normals, centers.colors)
    is_known = all(pose is not None for pose in run.true_poses)
    truth = np.stack(run.true_poses) if is_known else None
    paths = np.stack(run.poses), truth
    classes = () if dense.labels is None else dense.labels.classes
    draw_overview(folder / "overview.png", dense.cloud, paths, dense.pictures, title, classes)
    return [] if no_mesh is None else [f"no mesh.ply: {no_mesh}"]


def _picture(run: MappingRun, dataset: Dataset, row: int, view: Any) -> dict[str, Any]:
    return {
        "image": dataset[row].image,
        "rendered_color": view.colors,
        "rendered_depth": view.depth,
        "valid": view.valid,
        "title": f"frame {run.records[row].index}",
    }


def _labelled(centers: LabelledPoints, points: np.ndarray) -> LabelledPoints:
    return LabelledPoints(points, transfer_labels(centers.points, centers.labels, points, 1), centers.classes)


def _label_image(view: Any, centers: LabelledPoints | None) -> dict[str, np.ndarray]:
    """Class of each pixel (h, w), -1 = none."""
    if centers is None:
        return {}
    labels = np.full(view.valid.shape, -1)
    labels[view.valid] = _labelled(centers, view.points[view.valid]).labels
    return {"labels": labels}
