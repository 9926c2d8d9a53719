"""How well points are classified: labels carried to the true points, one confusion matrix, the metrics of OVO.

Classes are 0 … c - 1; any other number is no class. A confusion matrix is int64 (c, c + 1): rows are true classes,
columns predicted ones, and the last column counts points without an answer. Matrices of several scenes are added.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Dataset, Frame


@dataclass(frozen=True)
class LabelledPoints:
    """Points with a class each.

    Args:
        points: (n, 3), metres.
        labels: (n,), position in `classes`; any other number is no class.
        classes: their names.
    """

    points: np.ndarray
    labels: np.ndarray
    classes: tuple[str, ...]


def label_cells(frame: Frame, dataset: Dataset, voxel: float, max_depth: float) -> np.ndarray:
    """The voxels [m] of the world that a frame sees and the true class in them, each pair once: rows (n, 4)."""
    if frame.labels is None or frame.depth is None or frame.T_world_camera is None:
        return np.empty((0, 4), np.int64)
    known = (frame.labels >= 0) & (frame.depth > 0) & (frame.depth <= max_depth)
    points = backproject(frame.depth, dataset.intrinsics)[known]
    index = np.floor((points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]) / voxel)
    return _distinct(np.column_stack([index, frame.labels[known]]).astype(np.int64))


def true_labels(cells: Sequence[np.ndarray], dataset: Dataset, voxel: float) -> LabelledPoints | None:
    """A point for every class that is seen in a voxel [m]: its centre; None where no frame has `label_cells`."""
    if not any(map(len, cells)):
        return None
    rows = _distinct(np.concatenate(cells))
    return LabelledPoints((rows[:, :3] + 0.5) * voxel, rows[:, 3], tuple(dataset.classes))


def compare_labels(found: LabelledPoints, truth: LabelledPoints, num_neighbours: int) -> dict[str, float | int | None]:
    """Segmentation metrics of points in the frame of the truth; classes are the same where their names are."""
    number = {name: position for position, name in enumerate(truth.classes)}
    # A class that the truth does not know is a wrong answer, not a missing one: it takes part in the vote.
    positions = np.array([number.get(name, len(number)) for name in found.classes], np.int64)
    labels = np.where(found.labels >= 0, positions[found.labels], -1)
    predicted = transfer_labels(found.points, labels, truth.points, num_neighbours)
    return segmentation_metrics(confusion_matrix(truth.labels, predicted, len(truth.classes)))


def transfer_labels(points: np.ndarray, labels: np.ndarray, targets: np.ndarray, num_neighbours: int) -> np.ndarray:
    """Most frequent label among the nearest points of each target (m, 3); of equally frequent ones the smallest.

    Points (n, 3) whose label is negative are left out, as OVO does; without any other every target gets -1.
    """
    known = labels >= 0
    points, labels = points[known], labels[known].astype(np.int64)
    if not len(points):
        return np.full(len(targets), -1)
    k = min(num_neighbours, len(points))
    votes = labels[cKDTree(points).query(targets, k=[*range(1, k + 1)], workers=-1)[1]]
    counts = (votes[:, :, None] == votes[:, None, :]).sum(-1)
    candidates = np.where(counts == counts.max(1, keepdims=True), votes, np.iinfo(np.int64).max)
    return candidates.min(1)


def confusion_matrix(truth: np.ndarray, predicted: np.ndarray, num_classes: int) -> np.ndarray:
    """Count the pairs of true and predicted class (n,); rows without a true class do not count."""
    if truth.shape != predicted.shape:
        raise ValueError(f"truth {truth.shape} and predicted {predicted.shape} must match: transfer the labels first")
    counted = (truth >= 0) & (truth < num_classes)
    truth, predicted = truth[counted].astype(np.int64), predicted[counted].astype(np.int64)
    predicted = np.where((predicted >= 0) & (predicted < num_classes), predicted, num_classes)
    cells = np.bincount(truth * (num_classes + 1) + predicted, minlength=num_classes * (num_classes + 1))
    return cells.reshape(num_classes, num_classes + 1)


def segmentation_metrics(confusion: np.ndarray, ignored: Collection[int] = ()) -> dict[str, float | int | None]:
    """Metrics of OVO's `run_eval.py` in percent, and the share of points that are right; None without any true class.

    A class counts if it is true or predicted anywhere; one that is only predicted has IoU 0 and recall 0.
    f-mIoU weights the IoU by the number of true points. Of `ignored` classes the true points do not count;
    a point that is wrongly given to one is a miss.
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
    """Each row (n, 4) once; as `np.unique` along an axis, in a fifth of its time."""
    rows = rows[np.lexsort(rows.T)]
    return rows[np.append(True, (np.diff(rows, axis=0) != 0).any(1))] if len(rows) else rows
