"""Compare depth, colours and classes rendered from a run's poses with its frames."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.evaluation.reconstruction import EvaluationConfig
from emgs_jax.evaluation.segmentation import confusion_matrix, segmentation_metrics
from emgs_jax.evaluation.trajectory import align_poses

_TOLERANCE = 0.05  # of the true depth; it is in the name of the metric


@dataclass(frozen=True)
class ViewScore:
    """Errors of one rendered view; shares are of the pixels with true depth."""

    coverage: float  # share with a rendered depth
    within: float  # share whose rendered depth is within 5 % of the truth
    depth_l1: float | None = None  # mean absolute error of the depth, m; None where nothing is covered
    squared_error: float = 0.0  # of RGB in [0, 1], summed over covered pixels and channels
    num_colors: int = 0  # number of summands; 0 without rendered colours
    confusion: np.ndarray | None = None  # of the pixels with a true class, if classes are compared


class Rendered:
    """Compares rendered views with the frames of a data set, one by one.

    Args:
        poses: estimated and true (n, 4, 4), for the scale; None: nothing is compared.
        has_classes: views come with the classes of their pixels.
    """

    def __init__(
        self,
        dataset: Dataset,
        poses: tuple[np.ndarray, np.ndarray] | None,
        config: EvaluationConfig,
        has_classes: bool = False,
    ) -> None:
        self._dataset, self._max_depth = dataset, config.max_depth_m
        self._num_classes = len(dataset.classes) if has_classes else 0
        self._scale = depth_scale(poses, config) if poses is not None and dataset.has_ground_truth else None
        self._scores: dict[int, ViewScore | None] = {}

    def add(
        self, row: int, depth: np.ndarray | None, colors: np.ndarray | None, labels: np.ndarray | None = None
    ) -> None:
        """Add the view of a frame; `labels` are the class of each pixel, -1 = none, the rest is as for `score_view`."""
        if self._scale is None:
            return
        frame = self._dataset[row]
        score = score_view(frame, depth, colors, self._scale, self._max_depth)
        if score is not None and self._num_classes and frame.labels is not None:
            labels = np.full(frame.labels.shape, -1) if labels is None else labels
            score = replace(score, confusion=confusion_matrix(frame.labels, labels, self._num_classes))
        self._scores[row] = score

    def metrics(self) -> dict[str, float | int | None]:
        """`rendering_metrics`, where frames that were not added are lost; empty without truth."""
        if self._scale is None:
            return {}
        for row in sorted(set(range(len(self._dataset))) - set(self._scores)):
            self.add(row, None, None)
        return rendering_metrics(self._scores.values())


def depth_scale(poses: tuple[np.ndarray, np.ndarray], config: EvaluationConfig) -> float:
    """Factor from the estimate's unit to metres, by estimated and true poses (n, 4, 4); 1 for se3."""
    return align_poses(*poses, with_scale=config.alignment == "sim3")[0].scale


def score_view(
    frame: Frame, depth: np.ndarray | None, colors: np.ndarray | None, scale: float, max_depth: float
) -> ViewScore | None:
    """Compare a rendered view with its frame; None without true depth in (0, `max_depth`].

    Args:
        depth: rendered camera-space z (h, w) in the estimate's unit, 0 = none; None for a lost frame.
        colors: rendered RGB in [0, 1], (h, w, 3), or None.
        scale: `depth_scale` of the estimate.
    """
    truth = frame.static_depth
    is_known = None if truth is None else (truth > 0) & (truth <= max_depth)
    if is_known is None or not is_known.any():
        return None
    if depth is None:
        return ViewScore(0.0, 0.0)
    true, found = truth[is_known].astype(np.float64), scale * depth[is_known].astype(np.float64)
    is_covered = np.isfinite(found) & (found > 0)
    error, difference = np.abs(found - true)[is_covered], np.zeros(0)
    if colors is not None:
        difference = colors[is_known][is_covered].astype(np.float64) - frame.image[is_known][is_covered] / 255.0
    within = float(np.sum(error <= _TOLERANCE * true[is_covered]) / len(true))
    depth_l1, squares = float(error.mean()) if len(error) else None, float(np.sum(difference**2))
    return ViewScore(float(is_covered.mean()), within, depth_l1, squares, difference.size)


def rendering_metrics(views: Iterable[ViewScore | None]) -> dict[str, float | int | None]:
    """Means over the frames with true depth; flat keys, metres, percent and dB; None where undefined.

    A lost frame is covered nowhere. `rendering/depth_within_5_percent` is a share of all pixels with true depth,
    rendered or not; `rendering/depth_l1_m` is about rendered ones, and leaves out frames without any. The PSNR is that
    of all covered pixels together. Of the pixels with a true class one without an answer is wrong.
    """
    views = [view for view in views if view is not None]
    errors = [view.depth_l1 for view in views if view.depth_l1 is not None]
    num_colors, squares = sum(view.num_colors for view in views), sum(view.squared_error for view in views)
    coverage = [100.0 * view.coverage for view in views]
    psnr = 10.0 * np.log10(num_colors / max(squares, 1e-12 * num_colors)) if num_colors else None
    counts = [view.confusion for view in views if view.confusion is not None]
    labels = segmentation_metrics(np.sum(counts, axis=0)) if counts else {}
    return {
        "rendering/coverage_percent": float(np.mean(coverage)) if views else None,
        "rendering/worst_coverage_percent": min(coverage, default=None),
        "rendering/depth_l1_m": float(np.mean(errors)) if errors else None,
        "rendering/depth_within_5_percent": 100.0 * float(np.mean([v.within for v in views])) if views else None,
        "rendering/psnr_db": None if psnr is None else float(psnr),
        "rendering/num_frames": len(views),
        "rendering/label_accuracy_percent": labels.get("segmentation/accuracy_percent"),
        "rendering/label_miou_percent": labels.get("segmentation/miou_percent"),
    }
