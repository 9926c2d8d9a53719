"""The folder of a run that is made by hand: two walls, cameras that look at them, and what a run says of itself."""

import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax.numpy as jnp
import numpy as np
from hand_run import STATUSES, hand_run, poses_along
from omegaconf import OmegaConf
from tiny_run import compose

from emgs_jax.config.configure import build_dataset
from emgs_jax.features.text import TextEmbeddings, save_text
from emgs_jax.gaussians import Gaussians
from emgs_jax.io.files import FrameLog, write_json
from emgs_jax.io.trajectory import save_trajectory_tum, to_tum
from emgs_jax.runs.files import save_progress

SIZE = 48, 40  # of the images, pixels
INTRINSICS = 40.0, 42.0, 22.0, 20.5  # all four differ, and the centre is not in the middle
CLASSES = "wall", "sofa"
SAME = {"compile_seconds": 0.0, "residual": 0.01, "scale": 1.0}  # of every frame


def two_walls() -> Gaussians:
    """A red wall 1 m in front of the cameras that hides the left half of a green one at 2 m; both face the cameras."""
    x, y = np.meshgrid(np.arange(-1.5, 2.5, 0.08), np.arange(-1.5, 1.5, 0.08), indexing="ij")
    far = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], 1)
    near = far[far[:, 0] < 0.5] * [1.0, 1.0, 0.5]
    means = np.concatenate([near, far]).astype(np.float32)  # near first: in the order of the map it would be covered
    is_near = np.arange(len(means)) < len(near)
    shade = 0.5 + 0.4 * np.sin(9 * means[:, :1]) * np.sin(7 * means[:, 1:2])
    colors = np.where(is_near[:, None], [0.9, 0.1, 0.1], [0.1, 0.8, 0.2]) * shade
    count = len(means)
    return Gaussians(
        means=jnp.asarray(means),
        covs=jnp.asarray(np.broadcast_to(np.diag([3e-3, 2.5e-3, 1e-4]), (count, 3, 3)), jnp.float32),
        colors=jnp.asarray(colors, jnp.float32),
        normals=jnp.asarray(np.broadcast_to([0.0, 0.0, -1.0], (count, 3)), jnp.float32),
        features=jnp.asarray(np.where(is_near[:, None], [0.0, 1.0], [1.0, 0.0]), jnp.float32),
        valid=jnp.ones(count, bool),
    )


@cache
def _settings() -> tuple[dict[str, Any], str]:
    """Config and fingerprint of the room that the run says it is of; composed once."""
    composed = compose("render.tile_capacity=512")
    return OmegaConf.to_container(composed, resolve=True), build_dataset(composed).fingerprint()


@cache
def _files(has_truth: bool) -> dict[str, bytes]:
    """All files but metrics.json by name; made once."""
    poses = poses_along(np.linspace(0.0, 0.5, len(STATUSES)))
    truth = poses_along(np.linspace(0.0, 0.55, len(STATUSES)))
    truth[:, 1, 3] = [0.0, 0.02, 0.0, 0.01, 0.0, 0.03]
    run = hand_run(poses, poses, list(truth) if has_truth else [None] * len(poses), gaussians=two_walls())
    with TemporaryDirectory() as name:
        folder = Path(name)
        save_progress(folder, run)
        placed = [row for row, status in enumerate(STATUSES) if status != "lost"]
        times, online = [run.records[row].timestamp for row in placed[1:]], poses_along(np.linspace(0.1, 0.7, 5))
        save_trajectory_tum(folder / "trajectory_online.txt", times, online[np.array(placed[1:]) - 1])
        save_text(folder / "text.npz", TextEmbeddings(CLASSES, np.eye(2, dtype=np.float32), (), {"prior": "simulated"}))
        with FrameLog(folder / "frames.jsonl") as log:
            for row, record in enumerate(run.records):
                line = {"index": row, "name": record.name, "status": record.status, "reason": None}
                known = {"true_pose": to_tum(truth[row]) if has_truth else None, "raw_pose": to_tum(truth[row] * 1.0)}
                known |= {"pose": to_tum(poses[row]), "seconds": 0.25, "new": row, "inliers": 100 * row}
                log.append(line | known | SAME)
        loops = [{"frame": 5, "other": 0, "outcome": "accepted"}]
        loops.append({"frame": 4, "other": 1, "outcome": "refused", "gate": "hull", "measured": 0.01})
        write_json(folder / "loops.json", loops)
        return {path.name: path.read_bytes() for path in folder.iterdir()}


def written_run(folder: Path, *, has_truth: bool = True, sequence: str = "room", **metrics: Any) -> Path:
    """Write what a run of six frames writes, one of them lost, with a back end and classes; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in _files(has_truth).items():
        (folder / name).write_bytes(content)
    config, fingerprint = _settings()
    data = {"name": "synthetic", "sequence": sequence, "fingerprint": fingerprint}
    data["camera"] = {"size": [640, 480], "intrinsics": [500.0, 500.0, 320.0, 240.0]}  # of the images on disk
    data["frames"] = {"size": SIZE, "intrinsics": INTRINSICS}
    block = {"format": 1, "protocol": "paper/sim3", "simulated": True, "git": None, "device": {"kind": "cpu"}}
    block |= {"prior": {"name": "simulated", "settings": {}}, "versions": {"emgs_jax": "0"}}
    block |= {"data": data, "config": config}
    errors = {"trajectory/ate_sim3_m": 0.012, "raw_prior/trajectory/ate_sim3_m": 0.03} if has_truth else {}
    (folder / "metrics.json").write_text(json.dumps(errors | metrics | {"provenance": block}))
    return folder
