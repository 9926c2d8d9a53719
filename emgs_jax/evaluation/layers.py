"""Share of a map with double walls: one surface in two layers, as drift leaves behind at a revisit."""

import numpy as np
from scipy.spatial import cKDTree

MAX_GAP_M = 0.15  # layers farther apart may be two surfaces
MIN_COS = 0.9  # of their normals; the two sides of a board face opposite ways
MIN_STDS = 2.0  # what is nearer is one layer, as thick as it is


def double_wall_share(means: np.ndarray, normals: np.ndarray, covs: np.ndarray) -> float | None:
    """Share of Gaussians that have another beside them on a second layer.

    That is one with a normal alike, nearer across than Gaussians stand apart (median distance to the nearest one), and
    along the normal between two standard deviations and 15 cm away. What truly stands that near behind another, facing
    the same way, counts too: compare maps of one scene.

    Args:
        means: (n, 3), metres.
        normals: (n, 3), unit.
        covs: (n, 3, 3), square metres.

    Returns:
        In [0, 1]; None for fewer than two Gaussians.
    """
    if len(means) < 2:
        return None
    tree = cKDTree(means)
    spacing = float(np.median(tree.query(means, k=2)[0][:, 1]))
    pairs = tree.query_pairs(float(np.hypot(spacing, MAX_GAP_M)), output_type="ndarray")
    pairs = pairs[np.einsum("nd,nd->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) > MIN_COS]
    a, b = pairs.T
    normal = normals[a] + normals[b]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = means[b] - means[a]
    gap = np.abs(np.einsum("nd,nd->n", offset, normal))
    across = np.sqrt(np.maximum(np.einsum("nd,nd->n", offset, offset) - gap**2, 0.0))
    variance = [np.einsum("nd,nde,ne->n", normal, covs[row], normal) for row in (a, b)]
    is_double = (across < spacing) & (gap > MIN_STDS * np.sqrt(np.maximum(*variance))) & (gap < MAX_GAP_M)
    return len(np.unique(pairs[is_double])) / len(means)
