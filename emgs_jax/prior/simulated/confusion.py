"""Classes that a segmenter takes for others from where it looks: an error that stays while the view does."""

import numpy as np
from jaxtyping import Float, Int

from emgs_jax.prior.simulated.noise import Stream

CELL = 2.0  # m between places from which it errs differently
SECTORS = 2.0  # steps of the viewing direction's coordinates in a unit: about 30° apart
OFFSET = 2**20  # random streams have no negative keys


def confused(
    labels: Int[np.ndarray, "h w"], T_world_camera: Float[np.ndarray, "4 4"], num_classes: int, share: float, seed: int
) -> Int[np.ndarray, "h w"]:
    """The labels as seen from one place in one direction, where each class is another one with probability `share`.

    All pixels of a class err together, and so do all frames of one cell and sector, so more frames from there are no
    more evidence; another view errs independently. A pixel without a class (-1) has none.
    """
    if share <= 0:
        return labels
    place = np.rint(T_world_camera[:3, 3] / CELL)
    view = np.rint(SECTORS * T_world_camera[:3, 2])
    key = (np.concatenate([place, view]) + OFFSET).astype(int).tolist()
    rng = np.random.default_rng((seed, Stream.CONFUSION, *key))
    taken_for = np.where(
        rng.random(num_classes) < share, rng.integers(num_classes, size=num_classes), range(num_classes)
    )
    return np.append(taken_for, -1)[labels].astype(labels.dtype)
