"""Score any other system: `python -m experiments.score trajectory=FILE points=FILE method=NAME dataset=…`.

Data, protocol and code are those of our own runs; the result lies beside them in `out`, and the next table of
`python -m experiments.evaluate` shows it.
"""

from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import build, build_dataset
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.timestamps import in_seconds
from emgs_jax.evaluation.clouds import read_cloud
from emgs_jax.evaluation.reconstruction import compare_clouds
from emgs_jax.evaluation.trajectory import associate, check_conventions, trajectory_metrics
from emgs_jax.io.ply_reader import num_faces
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.prior.base import Provenance
from emgs_jax.report.tables import average, full_table
from emgs_jax.runs.metrics import true_cloud
from emgs_jax.runs.provenance import PLACED_PERCENT, provenance, write_metrics
from emgs_jax.runs.results import METRICS_FILE, estimates_of, is_finished, result_folder

from .command import command

Metrics = dict[str, Any]
UNIT_STEP = 0.2  # of the log of a scale, within which it is that of another unit


def score(config: DictConfig) -> tuple[Metrics, Path]:
    """Compare a trajectory and a cloud with a data set; return the metrics and their file."""
    evaluation = build(config, "evaluation")
    dataset = build_dataset(config)
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    folder = result_folder(Path(config.out), dataset.name, dataset.sequence, config.method, 0)
    is_finished(folder, settings)  # raises if another result is there
    cloud = None if config.points is None else read_cloud(config.points, config.normal_neighbours)
    poses, truth, frames, counts = matched_poses(
        config.trajectory, dataset, config.max_time_difference, config.min_associated_percent
    )
    metrics = trajectory_metrics(poses, truth, frames) | counts
    if cloud is not None:
        metrics |= compare_clouds(cloud, true_cloud(dataset, evaluation), (poses, truth), evaluation)
    block = provenance(settings, dataset, Provenance(config.method, {}, config.simulated))
    metrics["provenance"] = block | {"prior": None, "method": config.method}
    folder.mkdir(parents=True, exist_ok=True)
    write_metrics(folder / METRICS_FILE, metrics)
    return metrics, folder / METRICS_FILE


def matched_poses(
    path: str, dataset: ReadableFrames, max_difference: float, min_percent: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, int]]:
    """Poses of a file, true poses of the same times (n, 4, 4), numbers of their frames (n,), and how many each has.

    Raises:
        ValueError: few match.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"trajectory={path} is no file: give a file with `timestamp tx ty tz qx qy qz qw`")
    times, poses = load_trajectory_tum(path)
    order = np.argsort(times, kind="stable")
    # ORB-SLAM3 and others write EuRoC's nanoseconds into this format.
    times, poses = in_seconds(times[order]), poses[order]
    what = f"{dataset.name} {dataset.sequence}"
    frames = (dataset[row] for row in range(len(dataset)))
    known = [
        (frame.timestamp, frame.T_world_camera, frame.index) for frame in frames if frame.T_world_camera is not None
    ]
    if not known:
        raise ValueError(f"{what} has no true poses to compare with: choose another data set")
    true_times = np.array([time for time, *_ in known])
    rows, true_rows = associate(times, true_times, max_difference)
    spans = f"Its timestamps are {_span(times)}, those of {what} {_span(true_times)}"
    if len(rows) < max(1, 0.01 * min_percent * min(len(times), len(known))):
        few = f"{len(rows)} of {len(times)} poses, which may be by chance, are" if len(rows) else "no pose is"
        raise ValueError(
            f"{path}: {few} within {max_difference:g} s of one of {len(known)} frames. {spans}: write "
            "the data set's timestamps (numbers of frames are none), choose the same frames (dataset.start, stop, "
            "stride), raise max_time_difference, or accept fewer (min_associated_percent)"
        )
    print(f"{path}: {spans}")
    truth = np.stack([known[row][1] for row in true_rows]).astype(np.float64)
    _check_twice(times, poses, path)
    check_conventions(poses[rows], truth, path)
    counts = {"score/num_poses": len(times), "score/num_frames": len(known)}
    numbers = np.array([known[row][2] for row in true_rows])
    return poses[rows], truth, numbers, counts | {PLACED_PERCENT: 100.0 * len(rows) / len(known)}


def _check_twice(times: np.ndarray, poses: np.ndarray, path: str) -> None:
    """Raise ValueError if two different poses have one of the ascending times."""
    differ = times[1:][(np.diff(times) == 0) & (poses[1:] != poses[:-1]).any((1, 2))]
    if len(differ):
        raise ValueError(
            f"{path} has different poses with the same time, {len(differ)} of them, the first at {differ[0]:.6f} s: "
            "keep one path, with all digits of its times"
        )


def coverage(metrics: Metrics, min_percent: float) -> str:
    """Describe how many poses and frames were matched, with a warning if they are few."""
    matched, frames = metrics["trajectory/num_frames"], metrics["score/num_frames"]
    percent = 100.0 * matched / frames
    text = f"{matched} of {metrics['score/num_poses']} poses are associated with true poses, which is {percent:.0f} % "
    text += f"of the {frames} selected frames that have one"
    if percent >= min_percent:
        return text
    return (
        f"{text}\nwarning: that is less than {min_percent:g} %, so the system used other frames than the ones that are "
        "selected or lost many, and its numbers must not be set beside ours: choose its frames (dataset.start, stop, "
        "stride), and check the timestamps (max_time_difference)"
    )


def unit_note(metrics: Metrics, alignment: str) -> str:
    """Name the unit of a path that is scored in metres and is a thousand or a hundred times as long; empty if none."""
    scale, units = metrics["trajectory/scale"], {1e-3: "millimetres", 1e-2: "centimetres", 1e3: "kilometres"}
    for factor, unit in units.items():
        if alignment == "se3" and scale and abs(np.log(scale / factor)) < UNIT_STEP:
            return (
                f"warning: the path is {1 / scale:.4g} times as long as the true one, as one in {unit}, and "
                "evaluation.alignment=se3 takes it for metres: write metres, or give evaluation.alignment=sim3"
            )
    return ""


def _span(times: np.ndarray) -> str:
    return f"{times.min():.3f} to {times.max():.3f}" if len(times) else "none"


@command("score")
def main(config: DictConfig) -> None:
    metrics, path = score(config)
    print(full_table(average(estimates_of(path), each_sequence=True)))
    print(coverage(metrics, config.min_matched_percent))
    if note := unit_note(metrics, config.evaluation.alignment):
        print(note)
    if config.points is not None and num_faces(config.points):
        print(
            f"warning: {config.points} is a mesh, and its vertices are what was compared: where triangles are larger "
            "than a centimetre or two give points that are sampled on them"
        )
    print(f"everything is in {path}")


if __name__ == "__main__":
    main()
