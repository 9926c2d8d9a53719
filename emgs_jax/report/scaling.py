"""A run in another unit: copies of its trajectory, map and clouds with all lengths times one factor."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.io.files import write_json
from emgs_jax.io.map_file import save_map
from emgs_jax.io.ply_reader import scale_ply
from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum
from emgs_jax.report.recorded_run import RecordedRun

TRAJECTORIES, CLOUDS = ("trajectory.txt", "trajectory_online.txt"), ("map.ply", "points.ply", "mesh.ply")
SHORTEST = 1e-6  # of the run's unit; a shorter distance between two cameras says nothing about a scale


def factor_of(run: RecordedRun, length: Sequence[float]) -> float:
    """The factor that makes the distance between two cameras as long as it is known to be.

    Args:
        run: whose poses.
        length: two frames, as `index` of frames.jsonl numbers them, and metres between their camera centres.

    Raises:
        ValueError: not two frames with a pose that means something and a length above 0, or they are at one place.
    """
    if len(length) != 3 or not math.isfinite(length[2]) or length[2] <= 0 or any(n != int(n) for n in length[:2]):
        raise ValueError(f"length must be [frame,frame,metres], two numbers of frames and a length, got {[*length]}")
    centers = []
    for number in map(int, length[:2]):
        found = [row for row, frame in enumerate(run.frames) if frame["index"] == number]
        if not found or run.frames[found[0]]["status"] == "lost":
            why = "is lost, so its pose is a guess" if found else "is none of the run's"
            raise ValueError(f"length={[*length]}: frame {number} {why}: take another one (index in frames.jsonl)")
        centers.append(run.poses[found[0]][:3, 3])
    distance = float(np.linalg.norm(centers[1] - centers[0]))
    if distance < SHORTEST:
        raise ValueError(f"length={[*length]}: these two cameras are at one place: take two that are far apart")
    return length[2] / distance


def write_scaled(run: RecordedRun, folder: Path, factor: float) -> RecordedRun:
    """Write trajectories, map.npz, clouds and scale.json into `folder`, which is there; returns the run in that unit.

    About the origin of the world, which stays. What the run does not have is left out; truth and features stay.
    """
    for name in TRAJECTORIES:
        if (run.folder / name).is_file():
            times, poses = load_trajectory_tum(run.folder / name)
            save_trajectory_tum(folder / name, times, _scaled_poses(poses, factor))
    scaled = replace(run, folder=folder, poses=_scaled_poses(run.poses, factor), map=scaled_map(run.map, factor))
    save_map(folder / "map.npz", scaled.map)
    for name in CLOUDS:
        if (run.folder / name).is_file():
            scale_ply(run.folder / name, folder / name, factor)
    write_json(folder / "scale.json", {"factor": factor, "of": run.folder.resolve().name})
    return scaled


def scaled_map(map: GaussianMap, factor: float) -> GaussianMap:
    """Means and covariances of the valid rows in another unit; free rows stay neutral."""
    gaussians = map.gaussians
    means = np.asarray(gaussians.means) * np.float32(factor)
    is_valid = np.asarray(gaussians.valid)[:, None, None]
    covs = np.where(is_valid, np.asarray(gaussians.covs) * np.float32(factor**2), gaussians.covs)
    means = np.where(is_valid[..., 0], means, gaussians.means)
    return eqx.tree_at(lambda m: (m.gaussians.means, m.gaussians.covs), map, (means, covs))


def _scaled_poses(poses: np.ndarray, factor: float) -> np.ndarray:
    scaled = poses.copy()
    scaled[:, :3, 3] *= factor
    return scaled
