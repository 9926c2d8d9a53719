"""Landmarks that no view of the window shows any more, kept so that a view after a loss can find them again."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Memory:
    """Landmarks, the newest last.

    Args:
        points: (m, 3) in the reference frame.
        descriptors: (m, 128) float32, unit.
    """

    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, 128), np.float32))


def remember(memory: Memory, points: np.ndarray, descriptors: np.ndarray, max_remembered: int) -> Memory:
    """Memory with these landmarks; the oldest go where it would hold more than `max_remembered`."""
    first = max(len(memory.points) + len(points) - max_remembered, 0)
    both = (memory.points, points), (memory.descriptors, descriptors)
    return Memory(*(np.concatenate(arrays)[first:] for arrays in both))


def without(memory: Memory, rows: np.ndarray) -> Memory:
    """Memory without these landmarks."""
    return Memory(np.delete(memory.points, rows, axis=0), np.delete(memory.descriptors, rows, axis=0))
