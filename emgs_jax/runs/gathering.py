"""Gather data for comparison while a sequence is mapped: raw predictions and baselines."""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx
import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.data.reading import resize_nearest
from emgs_jax.data.spool import Spool
from emgs_jax.evaluation.baselines import BaselineConfig, Fusion, Pinhole, View
from emgs_jax.evaluation.clouds import PointCloud, SpooledCloud
from emgs_jax.evaluation.reconstruction import EvaluationConfig, camera_cloud, posed
from emgs_jax.evaluation.segmentation import SpooledLabels, nearest_classes
from emgs_jax.geometry import rotated
from emgs_jax.mapping.records import IN_MAP, FrameRecord
from emgs_jax.mapping.window_input import RawView
from emgs_jax.observation import ObservationConfig, known_surface

has_normal = eqx.filter_jit(known_surface)

Text = tuple[tuple[str, ...], np.ndarray]  # names of classes and their embeddings (c, f)


@dataclass(frozen=True)
class RawPrior:
    """Raw predictions of a sequence, without any mapping."""

    cloud: SpooledCloud  # its points at its poses; a voxel's side in its lengths is known once the poses are aligned
    points: Spool  # camera-frame points of each frame (h, w, 3), in the prior's own lengths; 0 for none
    classes: Spool | None = None  # of each frame's pixels (h, w), as positions in the prior's names, -1 = none
    labels: SpooledLabels | None = None  # its points, each with the class that its frame sees there


class Baselines:
    """Every baseline twice: from the prior's views at the prior's own poses, and at ours.

    At our poses it uses what the map used: frames that are tracked or from which the map was made, their points with a
    normal, at the scale that the map gave the prediction. So only the fusion differs.

    The first view converts sizes in metres to lengths of the poses: the unit is the median ratio of its true depths to
    its predicted ones, so that the prior's own unit does not matter; 1 m without true depth.
    """

    def __init__(self, configs: Mapping[str, BaselineConfig], observation: ObservationConfig, dataset: Dataset) -> None:
        self.raw: dict[str, Fusion] = {}
        self.ours: dict[str, Fusion] = {}
        self.poses: list[np.ndarray] = []  # our poses at that time: the finished run has another unit
        self._configs, self._observation, self._dataset = configs, observation, dataset

    @property
    def has_any(self) -> bool:
        """Whether there is a baseline."""
        return bool(self._configs)

    def add(self, record: FrameRecord, view: View, points: np.ndarray, mask: np.ndarray, raw_pose: np.ndarray) -> None:
        """Add the frame of a record, with its points (h, w, 3), where they are known, and its raw pose."""
        row = len(self.poses)
        self.poses.append(record.pose)
        if not self._configs:
            return
        self._fuse(self.raw, row, view, raw_pose, 1.0)
        if record.status in IN_MAP:
            taken = np.asarray(has_normal(points, mask, self._observation))
            cloud = PointCloud(*(values[taken[mask]] for values in vars(view.cloud).values()))
            view = View(np.where(taken, view.depth, np.float32(0.0)), view.image, cloud)
            self._fuse(self.ours, row, view, record.pose, 1.0 if record.scale is None else record.scale)

    def _fuse(self, into: dict[str, Fusion], row: int, view: View, T_world_camera: np.ndarray, scale: float) -> None:
        if not into:
            pinhole, truth = Pinhole(self._dataset.intrinsics, *self._dataset.size), self._dataset[row].depth
            unit = 1.0 if truth is None else unit_of(truth, scale * view.depth)
            into |= {name: config.start(pinhole, unit) for name, config in self._configs.items()}
        for fusion in into.values():
            fusion.add(view, T_world_camera, scale)


def unit_of(truth: np.ndarray, depth: np.ndarray) -> float:
    """Return the metres per unit of a depth (h, w), by the median over pixels known in both; 1 without any."""
    known = (truth > 0) & (depth > 0)
    return float(np.median(truth[known] / depth[known])) if known.any() else 1.0


def gather(
    frames: Iterable[tuple[FrameRecord | None, RawView]],
    evaluation: EvaluationConfig,
    keeps_points: bool,
    baselines: Baselines | None = None,
    text: Text | None = None,
    has_truth: bool = True,
) -> RawPrior:
    """Take all views of a sequence, each in another thread while the next frame is mapped.

    Args:
        frames: records, which baselines need, and views of all frames.
        keeps_points: keep the raw points, because the truth is known or the cloud is made from them.
        text: names and embeddings of the classes for labelling pixels; None: no labels.
        has_truth: true poses are known, with which the cloud is compared; otherwise it stays empty.
    """
    cloud, kept, classes = SpooledCloud(), Spool(), Spool()
    needs_cloud = has_truth or (baselines is not None and baselines.has_any)
    labels = None if text is None else SpooledLabels(text[0])

    def take(record: FrameRecord | None, view: RawView) -> None:
        points, mask, image, pose, features, _ = view
        known = mask & np.isfinite(points).all(-1)
        depth = np.where(known, points[..., 2], 0.0).astype(np.float32)
        seen = camera_cloud(points, mask, image, evaluation) if needs_cloud else PointCloud(*np.zeros((3, 0, 3)))
        if keeps_points:
            kept.append(np.where(known[..., None], points, 0.0).astype(np.float32))
        if text is not None:
            found = resize_nearest(nearest_classes(features, text[1]).astype(np.int32), depth.shape[::-1])
            classes.append(found)
            has_class = mask & (found >= 0)
            labels.append(rotated(points[has_class], pose[:3, :3]) + pose[:3, 3], found[has_class])
        if baselines is not None:
            baselines.add(record, View(depth, image, seen), points, known, pose)
        cloud.append(posed(seen, pose))

    with ThreadPoolExecutor(1, "raw prior") as thread:
        taken = thread.submit(int)
        for record, view in frames:
            taken.result()  # one at a time, to bound the memory; an error ends the mapping
            taken = thread.submit(take, record, view)
        taken.result()
    return RawPrior(cloud, kept, None if text is None else classes, labels)
