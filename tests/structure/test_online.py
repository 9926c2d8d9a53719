"""The structure of images as they come, against the truth and the images that have come."""

from functools import cache

import numpy as np
import pytest
from stereo_scene import similarity_error, structure_config

from emgs_jax.data.base import Frame
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.structure.sequence import follow_images

pytestmark = pytest.mark.slow
NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


class Coming(Synthetic):
    """The built-in room; some frames come twice, or show something else."""

    def __init__(self, count: int = 12, order=None, others=None) -> None:
        super().__init__(num_frames=40, stop=count, size=(160, 120))
        self.order, self.others = [*(order or range(count))], others or {}
        self.taken: list[int] = []

    def __len__(self) -> int:
        return len(self.order)

    def has(self, index: int) -> bool:
        return index < len(self.order)

    def __getitem__(self, index: int) -> Frame:
        self.taken.append(index)
        return Frame(index, float(index), "", self.others.get(index, rendered(self.order[index])))

    def truth(self) -> np.ndarray:
        return np.stack([rendered_pose(frame) for frame in self.order])


@cache
def drawn() -> Synthetic:
    return Synthetic(num_frames=40, size=(160, 120))


@cache
def rendered(index: int) -> np.ndarray:
    return drawn()[index].image


def rendered_pose(index: int) -> np.ndarray:
    return drawn().pose(index)


def followed(dataset: Coming, *words: str):
    return follow_images(dataset, structure_config("prior.structure.online=true", *words))


def error_of(found, truth: np.ndarray) -> float:
    placed = np.flatnonzero(found.is_placed)
    return similarity_error(found.T_world_camera[placed, :3, 3], truth[placed, :3, 3])
