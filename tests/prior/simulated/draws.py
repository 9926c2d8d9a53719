"""What the tests of the simulated prior ask: small frames whose relative poses are known by heart, and its errors."""

import hashlib
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Frame
from emgs_jax.prior.simulated.prior import Simulated

INTRINSICS = (9.0, 9.0, 4.0, 3.0)
SEEDS = range(300)
NO_WARP = {"warp": (), "warp_length": ()}
NO_DEPTH_NOISE = NO_WARP | {"pixel": 0.0, "flying_share": 0.0}
NO_PAIRS = {"pair_translation": 0.0, "pair_rotation": 0.0}


def prior_with(standard: dict, **options) -> Simulated:
    """The prior with other disturbances."""
    prior = Simulated(**options)
    prior.standard = replace(prior.standard, **standard)
    return prior


def ask(prior, dataset, window):
    return prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)


def digest(prediction) -> str:
    parts = prediction.T_anchor_view, prediction.points, prediction.confidence, prediction.mask, prediction.features
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def along(num_frames: int, step: float = 0.0, is_turned: bool = False) -> list[Frame]:
    """Frames 8 × 6 without turns, `step` metres apart along x; the first may look the other way: it shares nothing."""
    frames = []
    for index in range(num_frames):
        T_world_camera = np.diag([-1.0, 1.0, -1.0, 1.0]) if is_turned and index == 0 else np.eye(4)
        T_world_camera[0, 3] = step * index
        depth = np.full((6, 8), 2, np.float32)
        frames.append(Frame(index, 0.0, f"{index}", np.zeros((6, 8, 3), np.uint8), depth, T_world_camera))
    return frames


def errors(T_true: np.ndarray, T_predicted: np.ndarray) -> np.ndarray:
    """(v, ω) of inv(T_true) · T_predicted, (…, 6)."""
    T = np.linalg.inv(T_true) @ T_predicted
    rotations = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    return np.concatenate([T[..., :3, 3], rotations], axis=-1)
