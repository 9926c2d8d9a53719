"""Score finished maps against true classes, scene by scene, and make the counterpart of the paper's Table III."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax.evaluation.clouds import NearestPoints, register
from emgs_jax.evaluation.segmentation import (
    LabelledPoints,
    confusion_matrix,
    segmentation_metrics,
    transfer_labels,
)
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.gaussian_map import confirmed
from emgs_jax.geometry import Sim3
from emgs_jax.report.columns import DASH, MAIN, Table, cell, in_unit, markdown
from emgs_jax.runs.finished_run import FinishedRun
from emgs_jax.semantics import similarities

FORMAT, VERSION = "emgs_jax.segmentation", 1
_TITLES = ("method", "source", "protocol", "scenes", "placed by", "mIoU [%]", "f-mIoU [%]", "Acc [%]")
_NOTES = """
Acc is the mean recall of the classes. Quoted rows are not measured here: they are of eight scenes of Replica.
**simulated**: the prior is disturbed ground truth, which says nothing about a network and must not be compared with
quoted rows; neither must other scenes or protocols.
"""
_KEYS = {"miou": "miou", "fmiou": "fmiou", "acc": "mean_recall"}
PROTOCOL = "ovo"


@dataclass(frozen=True)
class Placement:
    """Alignment of a map with the truth: by the `trajectory`, or from there by a rigid ICP of the `points`."""

    by: str
    with_scale: bool  # also estimate a scale when aligning the poses
    icp_distance_m: float  # largest distance of ICP's pairs
    icp_max_steps: int


@dataclass(frozen=True)
class Counting:
    """OVO's protocol: each true point takes the most frequent class of the map's nearest points with a class.

    Args:
        num_neighbours: nearest points of the map that vote for a true point.
        ignored: names of classes whose true points do not count.
    """

    num_neighbours: int
    ignored: tuple[str, ...]

    def ignored_rows(self, classes: Sequence[str]) -> list[int]:
        """Return the positions of the ignored names, skipping those that are no classes."""
        return [row for row, name in enumerate(classes) if name in self.ignored]

    def metrics(self, confusion: np.ndarray, classes: Sequence[str]) -> dict[str, float | None]:
        """Compute mIoU, f-mIoU and Acc of a matrix in percent; None without any true point."""
        found = segmentation_metrics(confusion, self.ignored_rows(classes))
        return {name: found[f"segmentation/{key}_percent"] for name, key in _KEYS.items()}


@dataclass(frozen=True)
class SceneResult:
    """One map against the truth of its scene."""

    scene: str
    folder: str
    is_simulated: bool
    confusion: np.ndarray  # (c, c + 1), see `segmentation`; those of all scenes are added
    about: dict[str, Any]
    ate_m: float | None


def place(run: FinishedRun, truth: np.ndarray, how: Placement) -> tuple[np.ndarray, dict[str, Any]]:
    """Align the confirmed Gaussians' centres (n, 3) with true points (m, 3); say how. ValueError without true poses."""
    known = run.has_truth
    if not known.any():
        raise ValueError(f"{run.folder}/frames.jsonl has no true pose to place the map by: map a data set with truth")
    alignment, note = align_poses(run.poses[known], run.truth[known], how.with_scale)
    gaussians = jax.device_get(confirmed(run.map))
    points = alignment.apply(gaussians.means[gaussians.valid].astype(np.float64))
    about = {"placed_by": how.by, "alignment": _plain(alignment), "alignment_note": note}
    if how.by == "points":
        moved = register(points, NearestPoints(truth), how.icp_distance_m, how.icp_max_steps)
        points = moved.apply(points)
        about["icp"] = _plain(moved)
    return points, about


def score_scene(
    run: FinishedRun,
    scene: str,
    truth: LabelledPoints,
    vectors: np.ndarray,
    how: Placement,
    counting: Counting,
) -> SceneResult:
    """Compare the map of a run with the true points of its scene.

    `vectors` (c, f) are text embeddings of the true classes.
    """
    points, about = place(run, truth.points, how)
    gaussians = confirmed(run.map)
    rows = np.flatnonzero(gaussians.valid)
    cosines = np.asarray(similarities(gaussians, jnp.asarray(vectors, jnp.float32)))[rows]
    has_feature = np.asarray(gaussians.features)[rows].any(1)
    labels = np.where(has_feature, cosines.argmax(1), -1)
    true = np.where(np.isin(truth.labels, counting.ignored_rows(truth.classes)), -1, truth.labels)
    found = transfer_labels(points, labels, truth.points, counting.num_neighbours)
    confusion = confusion_matrix(true, found, len(truth.classes))
    distances = NearestPoints(points).query(truth.points)[0] if len(points) else np.array([np.inf])
    about |= {"num_gaussians": len(rows), "num_with_class": int((labels >= 0).sum())}
    about |= {"num_true_points": len(truth.points), "median_distance_to_map_m": float(np.median(distances))}
    about["data"] = run.provenance["data"]["name"]
    is_simulated = bool(run.provenance.get("simulated", False))
    ate = run.metrics.get("trajectory/ate_sim3_m")
    return SceneResult(scene, str(run.folder), is_simulated, confusion, about, ate)


def summary(
    results: Sequence[SceneResult], classes: Sequence[str], counting: Counting, how: Placement
) -> dict[str, Any]:
    """Build the contents of the file: metrics of all scenes and of each, IoU of each class, and the matrices."""
    total = np.sum([result.confusion for result in results], axis=0)
    right, true = np.diagonal(total), total.sum(1)
    union = true + total.sum(0)[: len(classes)] - right
    ates = [result.ate_m for result in results]
    mean_ate = {"ate_sim3_m": None if None in ates else float(np.mean(ates))}
    return {
        "format": FORMAT,
        "version": VERSION,
        "protocol": {"name": PROTOCOL} | asdict(counting),
        "placement": asdict(how),
        "simulated": any(result.is_simulated for result in results),
        "total": counting.metrics(total, classes) | mean_ate,
        "scenes": [
            {"scene": result.scene, "map": result.folder, "simulated": result.is_simulated, "ate_sim3_m": result.ate_m}
            | counting.metrics(result.confusion, classes)
            | result.about
            | {"confusion": result.confusion}
            for result in results
        ],
        "classes": list(classes),
        "by_class": {
            name: {
                "iou_percent": 100.0 * right[row] / union[row],
                "recall_percent": 100.0 * right[row] / true[row] if true[row] else None,
                "num_true": int(true[row]),
            }
            for row, name in enumerate(classes)
            if union[row] > 0
        },
    }


def table(found: Mapping[str, Any], published: Sequence[Mapping[str, Any]]) -> str:
    """Write the sum over the scenes, each scene, and quoted rows in Markdown.

    Args:
        published: method, source, protocol, and `values`: mIoU, f-mIoU, Acc and ATE [cm], null where unknown.
    """
    scenes = found["scenes"]
    lines = [_line(f"one matrix of {len(scenes)}", found["total"], found["simulated"], found)]
    if len(scenes) > 1:
        lines += [_line(scene["scene"], scene, scene["simulated"], found) for scene in scenes]
    for row in published:
        cells = [DASH if value is None else f"{value:g}" for value in row["values"]]
        lines.append([row["method"], f"quoted: {row['source']}", row["protocol"], "8 of Replica", DASH, *cells])
    (ate,) = in_unit(MAIN[:1], {scene["data"] for scene in scenes})
    return markdown(Table([*_TITLES, ate.title], lines)) + _NOTES


def _line(scenes: str, values: Mapping[str, Any], is_simulated: bool, found: Mapping[str, Any]) -> list[str]:
    cells = [cell(values[name], None, 1.0, 1) for name in _KEYS] + [cell(values["ate_sim3_m"], None, 100.0, 1)]
    source = "**simulated**" if is_simulated else "measured"
    return ["ours", source, found["protocol"]["name"], scenes, found["placement"]["by"], *cells]


def _plain(alignment: Sim3) -> dict[str, Any]:
    return {"scale": alignment.scale, "rotation": alignment.rotation, "translation": alignment.translation}
