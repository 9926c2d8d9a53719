"""Segmentation of maps under the protocols of three peers: what is compared with what, and which classes count.

One scene gives a confusion matrix, int64 (c, c + 1) as in `segmentation`; scenes are added or their metrics averaged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from emgs_jax.evaluation.clouds import NearestPoints
from emgs_jax.evaluation.segmentation import (
    LabelledPoints,
    confusion_matrix,
    most_seen,
    segmentation_metrics,
    transfer_labels,
)
from emgs_jax.ops.ranges import number, one_of

NAMES = ("miou", "fmiou", "acc")


@dataclass(frozen=True)
class SegmentationProtocol:
    """Protocol by which labels of a map are compared with the truth. Values: conf/protocol.

    Args:
        compared_at: `truth`: each true point takes the most frequent class of the map's nearest points; or `map`: each
            point of the map is compared with the nearest true point.
        num_neighbours: of the map, that vote for a true point; not used at `map`.
        none_votes: points of the map without a class vote, for no class, and win a tie; else they are left out.
        voxel_m: both clouds become one point a voxel, with its most frequent class (none counts, and wins a tie), of a
            grid with a centre at the origin; 0 = points as they are.
        offered: classes that a point may be given: `all`, `kept` (but the ignored ones), or `scene` (of these, those
            that the truth of the scene has).
        ignored: names whose true points do not count.
        logit_scale: a point's probabilities are the softmax of its cosines times this.
        min_probability: a point whose largest probability is less has no class.
        min_class_probability: a class whose probability is less at every point of the scene is given to none.
        counted: classes of a mean: `seen` (true or predicted anywhere), or `in_truth`.
        scenes: `sum` (one matrix of all) or `mean` (of each scene's metrics).
        accuracy: what is called Acc: `mean_recall` of the classes, or `overall`, the share of the points.
    """

    name: str
    compared_at: str = one_of("truth", "map")
    num_neighbours: int = number(low=1, high=1000)
    none_votes: bool = field()
    voxel_m: float = number(low=0, high=1000)
    offered: str = one_of("all", "kept", "scene")
    ignored: list[str] = field()
    logit_scale: float = number(low=1e-6, high=1e6)
    min_probability: float = number(low=0, high=1)
    min_class_probability: float = number(low=0, high=1)
    counted: str = one_of("seen", "in_truth")
    scenes: str = one_of("sum", "mean")
    accuracy: str = one_of("mean_recall", "overall")


def ignored_positions(classes: Sequence[str], protocol: SegmentationProtocol) -> list[int]:
    """The positions of the protocol's ignored names among the classes; names that are no classes are skipped."""
    return [position for position, name in enumerate(classes) if name in protocol.ignored]


def give_classes(
    cosines: np.ndarray, is_known: np.ndarray, true_labels: np.ndarray, ignored: Sequence[int], p: SegmentationProtocol
) -> np.ndarray:
    """Class of each point of a map; -1 = none.

    Args:
        cosines: of its feature with each class, (n, c).
    """
    offered = np.ones(cosines.shape[1], bool)
    if p.offered != "all":
        offered[list(ignored)] = False
    if p.offered == "scene":
        offered &= np.isin(np.arange(len(offered)), true_labels)
    if not offered.any() or not is_known.any():
        return np.full(len(cosines), -1)
    # A class that is not offered is no prompt, so it takes no part in the softmax.
    logits = np.where(offered, p.logit_scale * cosines.astype(np.float64), -np.inf)
    shares = np.exp(logits - logits.max(1, keepdims=True))
    shares /= shares.sum(1, keepdims=True)
    shares[:, shares[is_known].max(0) < p.min_class_probability] = 0.0
    best = np.where(shares.max(1) > 0, np.where(shares > 0, logits, -np.inf).argmax(1), -1)
    return np.where(is_known & (shares.max(1) >= p.min_probability), best, -1)


def scene_confusion(
    found: LabelledPoints, truth: LabelledPoints, ignored: Sequence[int], p: SegmentationProtocol
) -> np.ndarray:
    """Confusion matrix of one scene; both clouds in one frame and with the same classes."""
    if found.classes != truth.classes:
        raise ValueError("map and truth must have the same classes: give both in the truth's order")
    true = np.where(np.isin(truth.labels, list(ignored)), -1, truth.labels)
    points, labels = voxel_labels(found.points, found.labels, p.voxel_m)
    true_points, true = voxel_labels(truth.points, true, p.voxel_m)
    if not len(points) or not len(true_points):
        labels = np.full(len(true), -1)
    elif p.compared_at == "map":
        true = true[NearestPoints(true_points).query(points)[1][:, 0]]
    else:
        none = int(p.none_votes)  # a class of its own, or left out
        labels = transfer_labels(points, labels + none, true_points, p.num_neighbours) - none
    return confusion_matrix(true, labels, len(truth.classes))


def voxel_labels(points: np.ndarray, labels: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """One point (n, 3) a voxel with its most frequent label (n,), of equally frequent ones the smallest.

    A label of -1 counts as one. Voxels of 0 m change nothing.
    """
    if voxel <= 0 or not len(points):
        return points, labels
    cells, voxels = np.unique(np.rint(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    return cells * voxel, most_seen(np.column_stack([labels, voxels.ravel()]))[:, 0]


def table_metrics(
    matrices: Sequence[np.ndarray], ignored: Sequence[int], p: SegmentationProtocol
) -> dict[str, float | None]:
    """mIoU, f-mIoU and Acc in percent over the scenes of `scene_confusion`; None without any true point."""
    if p.scenes == "sum":
        return matrix_metrics(np.sum(matrices, axis=0), ignored, p)
    each = [matrix_metrics(matrix, ignored, p) for matrix in matrices]
    values = {name: [one[name] for one in each if one[name] is not None] for name in NAMES}
    return {name: float(np.mean(found)) if found else None for name, found in values.items()}


def matrix_metrics(confusion: np.ndarray, ignored: Sequence[int], p: SegmentationProtocol) -> dict[str, float | None]:
    """mIoU, f-mIoU and Acc in percent of one matrix; None without any true point."""
    num_true = confusion.sum(1)
    if p.counted == "in_truth":
        ignored = np.flatnonzero(num_true == 0)
        if p.compared_at == "map":  # as ConceptGraphs: the columns of these classes are left out, too
            confusion = confusion.copy()
            confusion[:, ignored] = 0
    found = segmentation_metrics(confusion, ignored)
    keys = ("miou", "fmiou", "mean_recall" if p.accuracy == "mean_recall" else "accuracy")
    return {name: found[f"segmentation/{key}_percent"] for name, key in zip(NAMES, keys, strict=True)}
