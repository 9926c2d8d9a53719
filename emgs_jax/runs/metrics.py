"""metrics.json of a run: map and raw prior against the truth, counts and times."""

import math
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.device.clock import Clock, peak_memory_mb
from emgs_jax.evaluation.clouds import PointCloud, SpooledCloud
from emgs_jax.evaluation.loops import double_wall_share, loop_metrics
from emgs_jax.evaluation.reconstruction import (
    EvaluationConfig,
    Reference,
    compare_clouds,
    compare_placements,
    ground_truth_cloud,
    not_compared,
    reference,
)
from emgs_jax.evaluation.rendering import Rendered
from emgs_jax.evaluation.segmentation import (
    LabelledPoints,
    SpooledLabels,
    TrueLabels,
    align_labels,
    compare_labels,
    translate,
)
from emgs_jax.evaluation.trajectory import align_poses, trajectory_metrics
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.geometry import scale_pose
from emgs_jax.mapping.records import APART, UNJOINED, UNPLACED, FrameRecord, longest_row, records_apart
from emgs_jax.mapping.run import MappingRun, placed_percent, row_of_first_node, rows_with_truth, with_truth
from emgs_jax.prior.base import SCALE_STD_KEY, Prior
from emgs_jax.runs.back_end import counts, found_loops
from emgs_jax.runs.gathering import Baselines, RawPrior, Text
from emgs_jax.runs.provenance import PLACED_PERCENT, RAW_PRIOR, prefixed

Metrics = dict[str, Any]
STATUSES = ("tracked", "degraded", "lost", APART, "initialization")


@dataclass(frozen=True)
class Scorer:
    """References for all maps of one data set, made once."""

    dataset: ReadableFrames
    evaluation: EvaluationConfig
    truth: Reference  # empty without ground truth
    labels: LabelledPoints | None  # the true classes; None where data set or prior have none
    prior: Prior | None  # its text embeddings are the classes of a map
    is_metric: bool  # lengths of the map are meant to be metres


def new_scorer(dataset: ReadableFrames, evaluation: EvaluationConfig, prior: Prior, is_metric: bool) -> Scorer:
    """Read the truth of a data set, reading each frame once."""
    labels = None
    if compared_text(dataset, prior) is not None:
        labels = TrueLabels(dataset, evaluation.voxel_m, evaluation.max_depth_m)
    truth = true_cloud(dataset, evaluation, labels)
    return Scorer(dataset, evaluation, truth, labels and labels.points(), prior, is_metric)


def compared_text(dataset: ReadableFrames, prior: Prior) -> Text | None:
    """Return the prior's classes, if the data set has true ones to compare them with."""
    return (tuple(prior.feature_names), prior.text_features) if dataset.classes and prior.feature_names else None


def true_cloud(dataset: ReadableFrames, config: EvaluationConfig, labels: TrueLabels | None = None) -> Reference:
    """Collect the true points of the frames with a known pose; `labels` gets each frame, too."""

    def frames() -> Iterator[Frame]:
        for row in range(len(dataset) if dataset.has_ground_truth else 0):
            frame = dataset[row]
            if labels is not None:
                labels.append(frame)
            yield frame

    return reference(ground_truth_cloud(frames(), dataset.intrinsics, config), config)


def score_map(
    run: MappingRun, dense: PointCloud, centers: PointCloud, labels: LabelledPoints | None, scorer: Scorer
) -> Metrics:
    """Compute trajectory, reconstruction and segmentation metrics of the map; empty without any true pose.

    The dense map is compared as the protocol says; under the other alignment as `reconstruction_<alignment>/…`; aligned
    by ICP as `reconstruction_icp/…`; and the centres alone as `reconstruction_centers/…`. If the map's unit is not
    the metre, there is no comparison without scale: the distances would only reflect the unit.
    """
    poses, truth, config = with_truth(run, run.poses), scorer.truth, scorer.evaluation
    if poses is None:
        has_truth = any(pose is not None for pose in run.true_poses)
        return {PLACED_PERCENT: placed_percent(run)} if has_truth else {}
    other = replace(config, alignment="se3" if config.alignment == "sim3" else "sim3")
    metrics = trajectory_metrics(*poses, rows_with_truth(run))
    metrics |= {PLACED_PERCENT: placed_percent(run)} | score_cloud(dense, poses, scorer)
    if other.alignment == "sim3" or scorer.is_metric:
        compared = compare_clouds(dense, truth, poses, other)
    else:
        compared = not_compared(other, "the map's unit is not the metre") | {"reconstruction/alignment_note": None}
    metrics |= _renamed(compared, f"reconstruction_{other.alignment}/")
    metrics |= _renamed(compare_clouds(centers, truth, poses, config), "reconstruction_centers/")
    return metrics | _score_labels(labels, poses, scorer)


def score_cloud(cloud: PointCloud | SpooledCloud, poses: tuple[np.ndarray, np.ndarray], scorer: Scorer) -> Metrics:
    """Compute reconstruction metrics of a cloud as the protocol says, and aligned by ICP as `reconstruction_icp/…`.

    ICP starts from the protocol's alignment and moves the cloud rigidly. An almost straight path does not determine the
    rotation about itself, and then the first alignment measures that more than the cloud.
    """
    config = scorer.evaluation
    distances = config.icp_distance_m, config.placement_icp_m
    found, placed = compare_placements(cloud, scorer.truth, poses, config, distances)
    return found | _renamed(placed, "reconstruction_icp/")


def score_prior(run: MappingRun, raw: RawPrior, scorer: Scorer) -> Metrics:
    """Compute trajectory, reconstruction, rendering and segmentation metrics of the raw prior.

    Its rendering is its own prediction of each frame; its segmentation is that of its points, with the class that most
    frames see there.
    """
    poses = with_truth(run, run.raw_poses)
    if poses is None:
        return {}
    rendered = Rendered(scorer.dataset, poses, scorer.evaluation, has_classes=raw.classes is not None)
    for row in range(len(raw.points)):
        names = None if raw.classes is None else (scorer.prior.feature_names, scorer.dataset.classes)
        rendered.add(row, raw.points[row][..., 2], None, names and translate(raw.classes[row], *names))
    with ThreadPoolExecutor(1, "classes of the raw prior") as thread:
        of_labels = thread.submit(_score_labels, raw.labels, poses, scorer)
        metrics = trajectory_metrics(*poses, rows_with_truth(run))  # over the frames of ours
        metrics |= {PLACED_PERCENT: placed_percent(run)}
        metrics |= score_cloud(raw.cloud, poses, scorer) | rendered.metrics()
        return prefixed(metrics | of_labels.result(), RAW_PRIOR)


def _score_labels(
    labels: LabelledPoints | SpooledLabels | None, poses: tuple[np.ndarray, np.ndarray], scorer: Scorer
) -> Metrics:
    """Compute segmentation metrics of points with classes, aligned like the cloud; empty without classes."""
    if labels is None or scorer.labels is None:
        return {}
    aligned = align_labels(labels, scorer.truth, poses, scorer.evaluation)
    return compare_labels(aligned, scorer.labels, scorer.evaluation.label_neighbours)


def score_baselines(run: MappingRun, baselines: Baselines, raw: RawPrior, scorer: Scorer) -> Metrics:
    """Compute reconstruction and rendering metrics of every baseline, aligned by the poses at which it was built.

    Every frame with a known pose is rendered: at our poses those that are not lost, at the prior's those with points.
    """
    is_known = {
        "raw": [raw.points[row].any() for row in range(len(raw.points))],
        "ours": [record.status not in UNPLACED for record in run.records],
    }
    metrics: Metrics = {}
    for kind, fusions, poses in (
        ("raw", baselines.raw, run.raw_poses),
        ("ours", baselines.ours, np.stack(baselines.poses)),
    ):
        compared = with_truth(run, poses)
        if compared is None:
            return {}
        for name, fusion in fusions.items():
            rendered, draw = Rendered(scorer.dataset, compared, scorer.evaluation), fusion.renderer()
            for row in np.flatnonzero(is_known[kind]):
                rendered.add(int(row), *draw(poses[row]))
            found = score_cloud(fusion.cloud(), compared, scorer) | rendered.metrics()
            metrics |= prefixed(found, f"baseline_{name}_{kind}/")
    return metrics


def describe(run: MappingRun, dataset: ReadableFrames | None = None) -> Metrics:
    """Count Gaussians and frames by outcome, and measure time and memory; without a data set no frame was skipped."""
    statuses = Counter(record.status for record in run.records)
    gaussians = jax.device_get(confirmed(run.state.map))
    metrics: Metrics = {"map/num_gaussians": int(gaussians.valid.sum())}
    metrics["map/double_wall_percent"] = _double_walls(gaussians, run)
    metrics["map/num_tentative"] = int(np.asarray(run.state.map.gaussians.valid).sum()) - metrics["map/num_gaussians"]
    metrics["map/capacity"] = run.config.submap.map_capacity
    metrics |= {f"frames/{status}": statuses[status] for status in STATUSES}
    metrics["frames/skipped"] = 0 if dataset is None else len(dataset.skipped)
    for number in run.apart:  # number of frames, and error of the path in its own unit
        records = records_apart(run.records, number)
        known = [(record.pose, record.true_pose) for record in records if record.true_pose is not None]
        metrics[f"submaps/{number}/frames"] = len(records)
        if len(known) >= 3:
            errors = trajectory_metrics(*map(np.stack, zip(*known, strict=True)))
            metrics[f"submaps/{number}/ate_sim3_m"] = errors["trajectory/ate_sim3_m"]
    metrics["submaps/unjoined_frames"] = sum(record.reason == UNJOINED for record in run.records)
    row = longest_row(run.records)
    metrics["frames/longest_untracked"] = len(row)
    start = run.records[row[0]].index if row else None
    metrics["frames/longest_untracked_from"] = start if start is None or dataset is None else dataset.kept[start]
    metrics["frames/overflow"] = sum(record.overflow or 0 for record in run.records)
    metrics["time/seconds_per_frame"] = seconds_per_frame(run.records)
    return metrics


def _double_walls(gaussians: Gaussians, run: MappingRun) -> float | None:
    """Compute the percentage of valid Gaussians with another one behind; the true path defines the metre."""
    poses = with_truth(run, run.poses)
    metre = None if poses is None else 1.0 / align_poses(*poses, with_scale=True)[0].scale
    rows = (values[gaussians.valid] for values in (gaussians.means, gaussians.normals, gaussians.covs))
    share = double_wall_share(*rows, metre)
    return None if share is None else 100.0 * share


def score_back_end(run: MappingRun) -> Metrics:
    """Score loop closures, relocalization, and the online poses (as first estimated); empty without a back end."""
    if run.back_end is None:
        return {}
    end = run.back_end
    online = [node.online for node in end.nodes[end.first_node :]]
    before = [record.pose for record in run.records[: row_of_first_node(run)]]
    poses = with_truth(run, np.stack([*before, *online])) if online else None
    causal = {} if poses is None else trajectory_metrics(*poses, rows_with_truth(run))
    causal = {key.replace("trajectory/", "trajectory_online/"): x for key, x in causal.items()}
    found = Counter(record.location for record in run.records if record.location is not None)
    located = {f"location/{name}": count for name, count in sorted(found.items())}
    return counts(end) | loop_metrics(*_loops(run), end.config.place_recognition.min_gap) | located | causal


def _loops(run: MappingRun) -> tuple[list[tuple[int, int, np.ndarray]], list[np.ndarray | None]]:
    """Return accepted and known loops in metres of the truth, with the true poses of their nodes."""
    end = run.back_end
    compared = with_truth(run, run.poses)
    unit = (None if compared is None else trajectory_metrics(*compared)["trajectory/scale"]) or 1.0
    loops = [
        (loop.a, loop.b, scale_pose(loop.Z_a_b, unit * np.exp(end.nodes[loop.a].log_scale)))
        for loop in found_loops(end)
    ]
    of_saved: list[np.ndarray | None] = [None] * end.first_node
    return loops, of_saved + run.true_poses[row_of_first_node(run) :]


def scale_off(metrics: Metrics) -> Metrics:
    """Return by how many standard deviations of its own the scale is off, if it has one and the truth is known.

    `trajectory/scale` is the factor to the truth: 1 for a map in right metres.
    """
    std, factor = metrics.get(SCALE_STD_KEY), metrics.get("trajectory/scale")
    return {} if not std or not factor else {"trajectory/scale_off_std": abs(math.log(factor)) / (0.01 * std)}


def spent(clock: Clock) -> Metrics:
    """Return seconds of each phase, including compilation; of compilation in all phases; and peak memory."""
    metrics: Metrics = {f"time/{name}_seconds": seconds for name, seconds in clock.phases.items()}
    metrics |= {"time/compile_seconds": clock.compile_seconds, "time/total_seconds": clock.total_seconds}
    return metrics | {"memory/peak_mb": peak_memory_mb()}


def seconds_per_frame(records: list[FrameRecord]) -> float | None:
    """Average over the steps without compilation; without any such step, over all, minus their compilation."""
    steps = [record for record in records if record.status != "initialization"] or records
    steady = [record.seconds for record in steps if record.compile_seconds == 0]
    return float(np.mean(steady or [record.seconds - record.compile_seconds for record in steps])) if steps else None


def _renamed(metrics: Metrics, prefix: str) -> Metrics:
    return {prefix + key.removeprefix("reconstruction/"): value for key, value in metrics.items()}
