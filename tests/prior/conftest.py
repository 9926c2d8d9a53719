"""A tiny data set with known truth: a box before a wall, seen by a camera that moves and turns."""

import math

import numpy as np
import pytest

from emgs_jax.data.base import Dataset, Frame


class Room(Dataset):
    """A `Dataset` of depth images that need no rendering; wall at 3 m, box at 2 m, a patch without depth."""

    name, sequence, classes, has_ground_truth = "room", "one", ("wall", "box"), True

    def __init__(self, num_frames: int = 6, size: tuple[int, int] = (40, 30)) -> None:
        self.num_frames, self.size = num_frames, size
        self.intrinsics = (50.0, 48.0, 19.25, 15.5)

    def __len__(self) -> int:
        return self.num_frames

    def pose(self, index: int) -> np.ndarray:
        return self[index].T_world_camera

    def __getitem__(self, index: int) -> Frame:
        width, height = self.size
        labels = np.zeros((height, width), np.int32)
        labels[height // 3 : 2 * height // 3, width // 4 + index : width // 2 + index] = 1
        depth = np.where(labels == 1, 2, 3).astype(np.float32)
        depth[:3, :5] = 0
        labels[:3, :5] = -1
        angle = 0.05 * index
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = [
            [math.cos(angle), 0, math.sin(angle)],
            [0, 1, 0],
            [-math.sin(angle), 0, math.cos(angle)],
        ]
        T_world_camera[:3, 3] = 1 + 0.06 * index, 2 - 0.02 * index, 0.01 * index
        image = np.full((height, width, 3), index, np.uint8)
        return Frame(index, float(index), f"{index}.png", image, depth, T_world_camera, labels)

    def fingerprint(self) -> str:
        return f"{self.num_frames} {self.size}"


@pytest.fixture
def make_room():
    return Room


@pytest.fixture
def room():
    return Room()
