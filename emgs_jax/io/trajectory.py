"""Trajectories in TUM's format: `timestamp tx ty tz qx qy qz qw`, metres, camera → world."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.io.files import write_file

MAX_VALUE, MAX_NORM_ERROR = 1e9, 1e-2  # other systems have their own units, and few digits


def save_trajectory_tum(path: str | os.PathLike, timestamps: Any, T_world_camera: Any) -> None:
    """Write poses (n, 4, 4) with qw ≥ 0."""
    poses, timestamps = np.asarray(T_world_camera, np.float64), np.asarray(timestamps, np.float64)
    if poses.shape != (len(timestamps), 4, 4) or not np.isfinite(poses).all():
        raise ValueError(f"T_world_camera must be finite ({len(timestamps)}, 4, 4), got {poses.shape}")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(timestamps, poses, strict=True):
        lines.append(" ".join([f"{time:.6f}", *(f"{value:.9f}" for value in to_tum(pose))]))
    write_file(path, "\n".join(lines) + "\n")


def to_tum(pose: np.ndarray) -> tuple[float, ...]:
    """tx, ty, tz, qx, qy, qz, qw of a pose (4, 4), qw ≥ 0."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return tuple(float(value) for value in (*pose[:3, 3], *quaternion))


def from_tum(values: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) of tx, ty, tz, qx, qy, qz, qw (n, 7); a row that is not finite gives nan."""
    is_finite = np.isfinite(values).all(1)
    poses = np.where(is_finite[:, None, None], np.eye(4), np.nan)
    poses[is_finite, :3, 3] = values[is_finite, :3]
    if is_finite.any():
        poses[is_finite, :3, :3] = Rotation.from_quat(values[is_finite, 3:]).as_matrix()
    return poses


def load_trajectory_tum(path: str | os.PathLike, may_lack: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Read timestamps (n,) and T_world_camera (n, 4, 4), float64; with `may_lack` a pose of nan is unknown."""
    rows = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        fields = line.split("#")[0].split()
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = [np.nan]
        if may_lack and len(values) == 8 and np.isnan(values[1:]).all():
            rows.append(values)
            continue
        if not fields:
            continue
        if len(values) != 8 or not np.isfinite(values).all():
            raise ValueError(f"{path}:{number}: expected `timestamp tx ty tz qx qy qz qw`, got {line[:80]!r}")
        if np.abs(values[1:]).max() > MAX_VALUE or abs(np.linalg.norm(values[4:]) - 1) > MAX_NORM_ERROR:
            what = f"a pose, with a quaternion of length 1 and a position within {MAX_VALUE:g}"
            raise ValueError(f"{path}:{number}: expected {what}, got {line[:80]!r}")
        rows.append(values)
    rows = np.array(rows, np.float64).reshape(-1, 8)
    return rows[:, 0], from_tum(rows[:, 1:])
