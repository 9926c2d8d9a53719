"""metrics.json of a run: the map against the truth, the prior alone against the truth, counts and times."""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from emgs_jax.clock import Clock, peak_memory_mb
from emgs_jax.data.base import Dataset
from emgs_jax.evaluation.clouds import PointCloud
from emgs_jax.evaluation.reconstruction import (
    EvaluationConfig,
    compare_clouds,
    ground_truth_cloud,
)
from emgs_jax.evaluation.report import RAW_PRIOR, prefixed
from emgs_jax.evaluation.trajectory import trajectory_metrics
from emgs_jax.pipeline import FrameRecord, MappingRun

Metrics = dict[str, Any]
STATUSES = ("tracked", "degraded", "lost", "initialization")


@dataclass(frozen=True)
class Clouds:
    """What is compared with the truth.

    Args:
        dense: the map, densified.
        centers: the Gaussians' means.
        raw_prior: the prior's points at the prior's poses.
    """

    dense: PointCloud
    centers: PointCloud
    raw_prior: PointCloud


def score(run: MappingRun, clouds: Clouds, dataset: Dataset, config: EvaluationConfig) -> Metrics:
    """Trajectory and reconstruction metrics of the map, and the same of the raw prior; empty without any true pose.

    The dense map is compared as `config` says, under the other alignment as `reconstruction_<alignment>/…`, and its
    plain centres as `reconstruction_centers/…`.
    """
    if all(pose is None for pose in run.true_poses):
        return {}
    truth = true_cloud(dataset, config)
    metrics = score_map(run, clouds.dense, clouds.centers, truth, config)
    return metrics | score_prior(run, clouds.raw_prior, truth, config)


def true_cloud(dataset: Dataset, config: EvaluationConfig) -> PointCloud:
    """The true points of the frames whose pose is known."""
    return ground_truth_cloud((dataset[row] for row in range(len(dataset))), dataset.intrinsics, config)


def score_map(
    run: MappingRun, dense: PointCloud, centers: PointCloud, truth: PointCloud, config: EvaluationConfig
) -> Metrics:
    """What `score` says of the map; `truth` is the `true_cloud`."""
    poses = _known(run, run.poses)
    other = replace(config, alignment="se3" if config.alignment == "sim3" else "sim3")
    metrics = trajectory_metrics(*poses) | compare_clouds(dense, truth, poses, config)
    metrics |= _renamed(compare_clouds(dense, truth, poses, other), f"reconstruction_{other.alignment}/")
    return metrics | _renamed(compare_clouds(centers, truth, poses, config), "reconstruction_centers/")


def score_prior(run: MappingRun, cloud: PointCloud, truth: PointCloud, config: EvaluationConfig) -> Metrics:
    """What `score` says of the raw prior, whose points are `cloud`."""
    poses = _known(run, run.raw_poses)
    return prefixed(trajectory_metrics(*poses) | compare_clouds(cloud, truth, poses, config), RAW_PRIOR)


def describe(run: MappingRun, num_skipped: int) -> Metrics:
    """Size of the map, how many frames came to what, time and memory."""
    counts = Counter(record.status for record in run.records)
    metrics: Metrics = {"map/num_gaussians": int(np.asarray(run.state.map.gaussians.valid).sum())}
    metrics["map/capacity"] = run.config.submap.map_capacity
    metrics |= {f"frames/{status}": counts[status] for status in STATUSES}
    metrics["frames/skipped"] = num_skipped
    metrics["frames/overflow"] = sum(record.overflow or 0 for record in run.records)
    metrics["time/seconds_per_frame"] = seconds_per_frame(run.records)
    return metrics


def spent(clock: Clock) -> Metrics:
    """Seconds of each phase, compilation included; of compilation in all phases; peak memory."""
    metrics: Metrics = {f"time/{name}_seconds": seconds for name, seconds in clock.phases.items()}
    metrics |= {"time/compile_seconds": clock.compile_seconds, "time/total_seconds": clock.total_seconds}
    return metrics | {"memory/peak_mb": peak_memory_mb()}


def seconds_per_frame(records: list[FrameRecord]) -> float | None:
    """Mean over the steps in which nothing was compiled; if there is none, over all without their compilation."""
    steps = [record for record in records if record.status != "initialization"] or records
    steady = [record.seconds for record in steps if record.compile_seconds == 0]
    return float(np.mean(steady or [record.seconds - record.compile_seconds for record in steps])) if steps else None


def _known(run: MappingRun, poses: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """`poses` and the true ones (n, 4, 4), of the frames whose true pose is known."""
    pairs = [(pose, true) for pose, true in zip(poses, run.true_poses, strict=True) if true is not None]
    ours, truth = zip(*pairs, strict=True)
    return np.stack(ours), np.stack(truth).astype(np.float64)


def _renamed(metrics: Metrics, prefix: str) -> Metrics:
    return {prefix + key.removeprefix("reconstruction/"): value for key, value in metrics.items()}
