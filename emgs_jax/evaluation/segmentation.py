"""Semantic segmentation of points: labels are transferred to the true points and scored with the metrics of OVO.

Classes are 0 … c - 1; any other number is no class. A confusion matrix is int64 (c, c + 1): rows are true classes,
columns predicted ones, the last column is no answer. Matrices of several scenes are added.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.class_file import ClassFile
from emgs_jax.evaluation.clouds import NearestPoints, SpooledRows, cell_centers, cell_numbers
from emgs_jax.evaluation.reconstruction import EvaluationConfig, Reference, align_points, own_voxel
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.geometry import rotated
from emgs_jax.io.ply_reader import read_vertices

_VOTED_ROWS, _MERGE_ROWS = 200_000, 1_000_000  # points that vote, rows that are merged at a time; bound the memory


@dataclass(frozen=True)
class LabelledPoints:
    """Points and their classes."""

    points: np.ndarray  # (n, 3), metres
    labels: np.ndarray  # (n,), position in `classes`; any other number is no class
    classes: tuple[str, ...]


class TrueLabels:
    """The true classes in the voxels [m] that labelled frames see; grows with what is seen, not with the frames."""

    def __init__(self, dataset: Dataset, voxel: float, max_depth: float) -> None:
        self._dataset, self._voxel, self._max_depth = dataset, voxel, max_depth
        self._rows = [np.empty((0, 2), np.int64)]  # distinct classes and cell numbers, by cell; the first is merged

    def append(self, frame: Frame) -> None:
        """Add what a frame sees."""
        if frame.labels is None or frame.depth is None or frame.T_world_camera is None:
            return
        known = (frame.labels >= 0) & (frame.static_depth > 0) & (frame.depth <= self._max_depth)
        points = backproject(frame.depth, self._dataset.intrinsics)[known]
        points = rotated(points, frame.T_world_camera[:3, :3]) + frame.T_world_camera[:3, 3]
        cells = cell_numbers(points, self._voxel)
        self._rows.append(_distinct(np.column_stack([frame.labels[known].astype(np.int64), cells])))
        if sum(map(len, self._rows[1:])) > max(_MERGE_ROWS, len(self._rows[0])):
            self._rows = [_distinct(np.concatenate(self._rows))]

    def points(self) -> LabelledPoints | None:
        """The centre of a voxel for each class that is seen in it; None if nothing is seen."""
        rows = _distinct(np.concatenate(self._rows))
        if not len(rows):
            return None
        return LabelledPoints(cell_centers(rows[:, 1], self._voxel), rows[:, 0], tuple(self._dataset.classes))


def align_labels(
    labels: "LabelledPoints | SpooledLabels",
    truth: Reference,
    poses: tuple[np.ndarray, np.ndarray],
    config: EvaluationConfig,
) -> LabelledPoints:
    """Move points with classes into the truth's frame, as `align_points` does."""
    if isinstance(labels, SpooledLabels):
        alignment, _ = align_poses(*poses, with_scale=config.alignment == "sim3")
        labels = labels.points(own_voxel(alignment, config))
    return replace(labels, points=align_points(labels.points, truth, poses, config))


def compare_labels(found: LabelledPoints, truth: LabelledPoints, num_neighbours: int) -> dict[str, float | int | None]:
    """Segmentation metrics of points in the truth's frame; classes are matched by name."""
    labels = translate(found.labels, found.classes, truth.classes)
    predicted = transfer_labels(found.points, labels, truth.points, num_neighbours)
    return segmentation_metrics(confusion_matrix(truth.labels, predicted, len(truth.classes)))


def translate(labels: np.ndarray, classes: Sequence[str], others: Sequence[str]) -> np.ndarray:
    """Translate labels of `classes` into those of `others` by name; a missing name becomes len(others), -1 stays."""
    number = {name: position for position, name in enumerate(others)}
    positions = np.array([number.get(name, len(number)) for name in classes] + [-1], np.int64)
    return positions[np.where(labels >= 0, labels, -1)]


def nearest_classes(features: np.ndarray, text_features: np.ndarray) -> np.ndarray:
    """The class whose embedding (c, f) is nearest by angle to each feature (…, f); -1 for a feature of zero."""
    length = np.linalg.norm(text_features, axis=1, keepdims=True)
    scores = features.astype(np.float32) @ (text_features / np.maximum(length, 1e-12)).T.astype(np.float32)
    return np.where(features.any(-1), scores.argmax(-1), -1)


class SpooledLabels:
    """Points of many views with their classes, as `SpooledRows` (n, 4): x, y, z, class."""

    def __init__(self, classes: Sequence[str]) -> None:
        self._rows, self._classes = SpooledRows(), tuple(classes)

    def append(self, points: np.ndarray, labels: np.ndarray) -> None:
        """Add the points (n, 3) of a view that are finite and have a class in labels (n,)."""
        known = labels >= 0
        self._rows.append(np.column_stack([points[known], labels[known]]))

    def points(self, voxel: float) -> LabelledPoints:
        """The centre of every voxel with the class of most views, of equally frequent ones the first."""

        def read(view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            pairs = _distinct(np.column_stack([view[:, 3].astype(np.int64), cell_numbers(view[:, :3], voxel)]))
            return pairs[:, 1], pairs

        found = [most_seen(rows) for rows in self._rows.by_ranges(voxel, read)]
        whole = np.concatenate([np.empty((0, 2), np.int64), *found])
        return LabelledPoints(cell_centers(whole[:, 1], voxel), whole[:, 0].astype(np.int32), self._classes)


def most_seen(rows: np.ndarray) -> np.ndarray:
    """The most frequent label of each cell, of equally frequent ones the first, from rows (n, 2) of label and cell."""
    rows = rows[np.lexsort(rows.T)]
    begins = np.flatnonzero((np.diff(rows, axis=0, prepend=-1) != 0).any(1))
    pairs, views = rows[begins], np.diff(begins, append=len(rows))
    order = np.lexsort((pairs[:, 0], -views, pairs[:, 1]))
    return pairs[order[np.diff(pairs[order, 1], prepend=-1) != 0]]


def transfer_labels(points: np.ndarray, labels: np.ndarray, targets: np.ndarray, num_neighbours: int) -> np.ndarray:
    """The most frequent label, of equal ones the smallest, among the nearest points of each target (m, 3); -1 without.

    Points (n, 3) with a negative label are left out, as OVO does.
    """
    known = labels >= 0
    points, labels = points[known], labels[known].astype(np.int64)
    if not len(points):
        return np.full(len(targets), -1)
    search, found = NearestPoints(points), np.empty(len(targets), np.int64)
    for begin in range(0, len(targets), _VOTED_ROWS):
        part = slice(begin, begin + _VOTED_ROWS)
        votes = labels[search.query(targets[part], num_neighbours)[1]]
        counts = (votes[:, :, None] == votes[:, None, :]).sum(-1)
        found[part] = np.where(counts == counts.max(1, keepdims=True), votes, np.iinfo(np.int64).max).min(1)
    return found


def confusion_matrix(truth: np.ndarray, predicted: np.ndarray, num_classes: int) -> np.ndarray:
    """Count pairs of true and predicted class (n,), where there is a true class."""
    if truth.shape != predicted.shape:
        raise ValueError(f"truth {truth.shape} and predicted {predicted.shape} must match: transfer the labels first")
    counted = (truth >= 0) & (truth < num_classes)
    truth, predicted = truth[counted].astype(np.int64), predicted[counted].astype(np.int64)
    predicted = np.where((predicted >= 0) & (predicted < num_classes), predicted, num_classes)
    cells = np.bincount(truth * (num_classes + 1) + predicted, minlength=num_classes * (num_classes + 1))
    return cells.reshape(num_classes, num_classes + 1)


def segmentation_metrics(confusion: np.ndarray, ignored: Collection[int] = ()) -> dict[str, float | int | None]:
    """Metrics of OVO's `run_eval.py` in percent, and the share of right points; None without any true class.

    A class counts if it is true or predicted anywhere; one that is only predicted has IoU 0 and recall 0. f-mIoU is
    weighted by the number of true points. True points of `ignored` classes do not count; predicting one is a miss.
    """
    num_classes = len(confusion)
    confusion = confusion.copy()
    confusion[list(ignored)] = 0
    right, true = np.diagonal(confusion), confusion.sum(1)
    union = true + confusion.sum(0)[:num_classes] - right
    counts = (union > 0) & ~np.isin(np.arange(num_classes), list(ignored))
    names = ("miou", "fmiou", "mean_recall", "accuracy")
    metrics: dict[str, float | int | None] = dict.fromkeys(f"segmentation/{name}_percent" for name in names)
    metrics["segmentation/num_points"] = int(true.sum())
    if not true.sum():
        return metrics
    iou, recall = right[counts] / union[counts], right[counts] / np.maximum(true[counts], 1)
    values = iou.mean(), np.average(iou, weights=true[counts]), recall.mean(), right.sum() / true.sum()
    return metrics | {f"segmentation/{name}_percent": 100.0 * float(v) for name, v in zip(names, values, strict=True)}


def _distinct(rows: np.ndarray) -> np.ndarray:
    """Distinct rows (n, 2), sorted by the second column, in a fifth of the time of `np.unique`."""
    rows = rows[np.lexsort(rows.T)]
    return rows[(np.diff(rows, axis=0, prepend=-1) != 0).any(1)]


def read_labelled_mesh(folder: Path, scene: str, classes: ClassFile) -> LabelledPoints:
    """Read a scene's vertices and their classes, -1 = none; ValueError if its files are missing or do not fit."""
    mesh, labels = folder / f"{scene}_mesh.ply", folder / f"{scene}.txt"
    missing = [path.name for path in (mesh, labels) if not path.is_file()]
    if missing:
        raise ValueError(
            f"truth={folder} lacks {', '.join(missing)}: give the folder with SCENE_mesh.ply and SCENE.txt (an id a "
            "vertex) of Replica, or name the scenes (scenes=[office0])"
        )
    vertices = read_vertices(mesh)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    try:
        ids = np.array(labels.read_bytes().split(), np.object_).astype(np.int64)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{labels} is no list of whole numbers, one a vertex ({error}): fetch it again") from error
    if len(ids) != len(points):
        raise ValueError(
            f"{labels} has {len(ids)} labels and {mesh} {len(points)} vertices: fetch both files of the same mesh"
        )
    return LabelledPoints(points, classes.positions_of(ids, labels), classes.names)
