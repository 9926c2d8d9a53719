"""metrics.json of a run: the map against the truth, the prior alone against the truth, counts and times."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from emgs_jax import outputs
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
from emgs_jax.mapping_run import FrameRecord, MappingRun
from emgs_jax.render.densify import DensifyConfig

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


@dataclass(frozen=True)
class Scorer:
    """What the maps of one data set are compared with, made once.

    Args:
        dataset: in use.
        evaluation: the protocol.
        truth: its true cloud; None without ground truth.
        num_skipped: frames that cannot be read.
    """

    dataset: Dataset
    evaluation: EvaluationConfig
    truth: PointCloud | None
    num_skipped: int


def score_settings(
    runs: Sequence[MappingRun],
    raw_cloud: PointCloud,
    densify: Sequence[DensifyConfig],
    scorer: Scorer,
    num_threads: int,
) -> list[Metrics]:
    """The metrics.json of every finished run, without times.

    Args:
        runs: that share data set, prior and protocol.
        raw_cloud: the prior's points, the same for all.
        densify: of each run.
        scorer: the truth.
        num_threads: runs that are scored side by side.
    """
    evaluation, truth = scorer.evaluation, scorer.truth
    shared = {} if truth is None else score_prior(runs[0], raw_cloud, truth, evaluation)

    def score(run: MappingRun, config: DensifyConfig) -> Metrics:
        counts = {k: v for k, v in describe(run, scorer.num_skipped).items() if not k.startswith("time/")}
        if truth is None:
            return counts
        dense = outputs.dense_map(run, scorer.dataset, config, evaluation.voxel_m, num_pictures=0).cloud
        centers = outputs.center_cloud(run)
        return score_map(run, dense, centers, truth, evaluation) | shared | counts

    first = score(runs[0], densify[0])
    with ThreadPoolExecutor(num_threads) as threads:
        return [first, *threads.map(score, runs[1:], densify[1:])]


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
