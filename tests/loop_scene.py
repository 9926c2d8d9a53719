"""Keyframes whose truth is known: points of a room with a descriptor each, seen by cameras; and the config of conf/."""

from functools import cache

import hydra
import numpy as np
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from emgs_jax.config.schema import schema_of
from emgs_jax.loop_closure.place_recognition import BYTES_PER_UNIT, Keyframe, PlaceRecognitionConfig
from emgs_jax.loop_closure.verification import Neighbour, VerificationConfig

SIZE, INTRINSICS = (320, 240), (250.0, 260.0, 155.0, 122.5)


@cache
def loops_config(*overrides: str) -> dict:
    """What graph=default says of loops, changed by words like `place_recognition.min_gap=5`."""
    parts = ["place_recognition", "verification", "consistency", "prior_query", "relocalization"]
    given = OmegaConf.masked_copy(OmegaConf.create(schema_of("graph/schema")), parts)
    config = OmegaConf.merge(given, OmegaConf.from_dotlist(list(overrides)))
    return hydra.utils.instantiate(config, _convert_="all")


def place_recognition_config(*overrides: str) -> PlaceRecognitionConfig:
    return loops_config(*(f"place_recognition.{word}" for word in overrides))["place_recognition"]


def verification_config(*overrides: str) -> VerificationConfig:
    return loops_config(*(f"verification.{word}" for word in overrides))["verification"]


def matrix(rotation_deg=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4) from a rotation vector in degrees and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix(), translation
    return T


def room(count: int = 300, seed: int = 0) -> np.ndarray:
    """Points (count, 3) 2 to 4 m before a camera at the origin, all over its image and somewhat beyond."""
    rng = np.random.default_rng(seed)
    fx, fy, _, _ = INTRINSICS
    x, y = rng.uniform(-0.7, 0.7, (2, count)) * np.array([[SIZE[0] / fx], [SIZE[1] / fy]])
    return np.column_stack([x, y, np.ones(count)]) * rng.uniform(2.0, 4.0, (count, 1))


def looks(count: int, seed: int = 7) -> np.ndarray:
    """Descriptors (count, 128) as bytes, no two alike."""
    unit = np.abs(np.random.default_rng(seed).normal(size=(count, 128))) ** 2
    unit = np.sqrt(unit / unit.sum(axis=1, keepdims=True))
    return np.uint8(np.clip(np.round(BYTES_PER_UNIT * unit), 0, 255))


def keyframe(
    points: np.ndarray, T_world_camera: np.ndarray, frame: int = 0, scale: float = 1.0, noise: float = 0.0
) -> Keyframe:
    """Which of the world's points a camera sees, in a random order.

    Args:
        scale: a metre in units of the inference.
        noise: of the depths, in their logarithm, along the rays.
    """
    rng = np.random.default_rng(1000 + frame)
    fx, fy, cx, cy = INTRINSICS
    local = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    pixels = local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy)
    is_seen = (local[:, 2] > 0.1) & (pixels >= 0).all(axis=1) & (pixels <= np.array(SIZE) - 1).all(axis=1)
    rows = rng.permutation(np.flatnonzero(is_seen))
    predicted = scale * local[rows] * np.exp(noise * rng.normal(size=(len(rows), 1)))
    no_depths = np.zeros((6, 8), np.float32)
    return Keyframe(
        frame, np.float32(pixels[rows]), looks(len(points))[rows], np.float32(predicted), INTRINSICS, SIZE, no_depths
    )


def neighbours_of(points: np.ndarray, T_world_candidate: np.ndarray, scale: float = 1.0) -> list[Neighbour]:
    """Two keyframes 20 cm beside the candidate, whose own units are 1.02 and .97 of a metre."""
    found = []
    for frame, (side, own) in enumerate(((-0.2, 1.02), (0.2, 0.97)), start=900):
        T = matrix((0, 2 * side, 0), (side, 0, 0))
        T[:3, 3] *= scale
        T_world = T_world_candidate @ matrix((0, 2 * side, 0), (side, 0, 0))
        found.append(Neighbour(keyframe(points, T_world, frame, own), T, float(np.log(scale / own))))
    return found
