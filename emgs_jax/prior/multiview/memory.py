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


def recognize(memory: Memory, descriptors: np.ndarray, max_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the memory and of a view's descriptors (n, 128) that are each other's nearest, distinctly so in the view.

    In the memory a point may be there twice, so the second nearest says nothing about the nearest.
    """
    if not len(memory.points) or len(descriptors) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    similarity = memory.descriptors @ descriptors.T
    nearest = similarity.argmax(axis=1)
    best, second = -np.partition(-similarity, 1, axis=1)[:, :2].T
    # Of unit vectors |d|² = 2 - 2 cos.
    is_distinct = 1 - best < max_ratio**2 * (1 - second)
    is_mutual = similarity.argmax(axis=0)[nearest] == np.arange(len(nearest))
    rows = np.flatnonzero(is_distinct & is_mutual)
    return rows, nearest[rows]
