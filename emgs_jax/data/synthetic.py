"""A furnished room, ray-cast: images with exact depth, poses, labels and normals, from nothing but a seed."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from emgs_jax.data import reading, room
from emgs_jax.data.looks import draw_looks
from emgs_jax.data.raycast import RayCast, Scene, level_poses
from emgs_jax.data.reading import Number

ARC = np.radians(140.0)  # of the round that the camera goes


class Synthetic(RayCast):
    """The camera goes round the middle of a room and looks across it: about 6.5 cm and 3.6 degrees a frame of 40.

    Args:
        seed: room, furniture, colours and path.
        num_frames: images along the path, which stays the same: more frames are nearer to each other.
        intrinsics: fx, fy, cx, cy at `size`; None = .82 times the width and the centre.
    """

    name = "synthetic"
    classes = room.CLASSES
    version = 1

    def __init__(
        self,
        seed: int = 0,
        num_frames: int = 40,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Sequence[int] = (320, 240),
        intrinsics: Sequence[Number] | None = None,
    ) -> None:
        if seed < 0 or num_frames < 1:
            raise ValueError(
                f"dataset.seed must be 0 or more and dataset.num_frames 1 or more, got {seed}, {num_frames}"
            )
        sequence = f"room{seed}"
        numbers = reading.select(num_frames, start, stop, stride, f"{self.name} {sequence}")
        rng = np.random.default_rng(seed)
        parts, room_size = room.build_room(rng)
        scene = Scene(parts, draw_looks(parts, rng))
        super().__init__(sequence, scene, camera_path(num_frames, room_size, rng), numbers, size, intrinsics)


def camera_path(
    num_frames: int, room_size: Float[np.ndarray, " 3"], rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera along an arc above the furniture, looking inward and a little down, without roll."""
    begin, sense, phase = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    round_ = np.linspace(0, ARC, num_frames)
    angle = begin + sense * round_
    a, b = room_size[0] / 2 - 1.25, room_size[1] / 2 - 1.05
    height = 1.5 + 0.06 * np.sin(2 * round_ + phase)
    positions = np.stack([a * np.cos(angle), b * np.sin(angle), height], axis=-1)
    yaw = angle + np.pi + np.radians(5) * np.sin(2 * round_ + phase)
    pitch = np.radians(-16) + np.radians(4) * np.sin(3 * round_ + phase)
    return level_poses(positions, yaw, pitch)
