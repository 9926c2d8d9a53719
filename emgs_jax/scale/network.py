"""The scale of a network that predicts depths in metres, by its ratio to the structure in each frame."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from emgs_jax.scale.estimate import Scale

SOURCE = "the depth network"


def log_ratio(
    metres: Float[np.ndarray, "k"], depth: Float[np.ndarray, "k"], weight: Float[np.ndarray, "k"], min_count: int
) -> float:
    """Return the weighted median of log(metres / depth) of a frame's landmarks; NaN with fewer than `min_count`.

    Args:
        metres: the network's values at the landmarks; NaN or 0 where it has none.
        depth: in units of the structure.
    """
    is_known = (metres > 0) & (depth > 0)
    if is_known.sum() < max(min_count, 1):
        return np.nan
    ratios = np.log(metres[is_known] / depth[is_known])
    order = np.argsort(ratios)
    below = np.cumsum(weight[is_known][order])
    return float(ratios[order][np.searchsorted(below, 0.5 * below[-1])])


def cells_of(points: Float[np.ndarray, "k 3"], side: float) -> set[tuple[int, ...]]:
    """Cells of a grid in the world that a frame's landmarks lie in."""
    return {*map(tuple, np.floor(points / side).astype(int).tolist())}


def scale_of_network(
    ratios: Float[np.ndarray, "n"], shown: Sequence[set[tuple[int, ...]]], bias_std: float
) -> Scale | None:
    """Combine the ratios r_k of the frames, each the mean of what the network errs by in the cells that it shows.

    Frames that show the same cells err alike: with b_k = 1 / √c in each of the c cells of frame k, the correlation of
    two frames is b_j·b_k, and n frames are worth n² / |Σ b_k|² independent ones. A bias of the scene, such as that of a
    room unlike those of the training, is the same in all frames and does not average out:

        σ² = bias² + s² |Σ b_k|² / n²,  s² = (Σ (r_k - r̄)² + bias²) / (n - |Σ b_k|² / n + 1),

    where the variance between frames counts as one more observed one that is that of the bias.

    Args:
        ratios: log of the metres of a unit by each frame; NaN where it says nothing.
        shown: cells of each frame's landmarks.
        bias_std: of the logarithm of a scene's scale.

    Returns:
        None if no frame says anything.
    """
    rows = np.flatnonzero(np.isfinite(ratios))
    if not len(rows):
        return None
    known, count, shares = ratios[rows], len(rows), {}
    for row in rows:
        for cell in shown[row]:
            shares[cell] = shares.get(cell, 0.0) + len(shown[row]) ** -0.5
    alike = max(sum(share**2 for share in shares.values()), float(count))  # frames without cells are independent
    mean = float(known.mean())
    between = (float(np.sum((known - mean) ** 2)) + bias_std**2) / (count - alike / count + 1)
    return Scale(SOURCE, mean, float(np.sqrt(bias_std**2 + between * alike / count**2)))
