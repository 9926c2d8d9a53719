"""Precision and recall of loops, and the share of a map that drift has doubled."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.geometry import pose_difference

MAX_GAP_M = 0.15  # layers farther apart may be two surfaces
MAX_GAP = 4.0  # likewise without metres, as a multiple of the Gaussians' spacing
MIN_COS = 0.9  # of their normals; the two sides of a board face opposite ways
MIN_STDS = 2.0  # nearer Gaussians are one thick layer
PLACE_M, PLACE_DEG = 1.0, 30.0  # two frames nearer than this show one place
RIGHT_M, RIGHT_DEG = 0.3, 10.0  # a loop with a larger error is false
_CHUNK = 512  # Gaussians at a time; each may have a thousand neighbours
REACH = 10  # frames beside a loop that count as found with it


def loop_metrics(
    loops: Sequence[tuple[int, int, np.ndarray]], truth: Sequence[np.ndarray | None], min_gap: int
) -> dict[str, float | int | None]:
    """Precision and recall of loops; None where undefined.

    A loop is right if its motion errs by at most 30 cm and 10°. A frame returns if it is within 1 m and 30° of one at
    least `min_gap` frames older, and is found if a right loop begins within 10 frames of it. It does not count if only
    loops without truth begin there, such as those into a saved map.

    A loop is frames a and b and the pose (4, 4) of camera b in camera a; `truth` is T_world_camera or None.
    """
    judged = [loop for loop in loops if truth[loop[0]] is not None and truth[loop[1]] is not None]
    right = [b for a, b, measured in judged if _is_right(measured, truth[a], truth[b])]
    unjudged = [b for a, b, _ in loops if truth[a] is None or truth[b] is None]
    returning = _returning(truth, min_gap)
    found = [_is_near(row, right) for row in returning if _is_near(row, right) or not _is_near(row, unjudged)]
    return {
        "loops/precision": len(right) / len(judged) if judged else None,
        "loops/recall": float(np.mean(found)) if found else None,
        "loops/returning_frames": len(returning),
    }


def _is_near(row: int, frames: Sequence[int]) -> bool:
    return any(abs(row - frame) <= REACH for frame in frames)


def _is_right(measured: np.ndarray, true_a: np.ndarray, true_b: np.ndarray) -> bool:
    distance, angle = pose_difference(np.linalg.inv(true_a) @ true_b, measured)
    return bool(distance <= RIGHT_M and angle <= RIGHT_DEG)


def _returning(truth: Sequence[np.ndarray | None], min_gap: int) -> list[int]:
    rows, found = [row for row, pose in enumerate(truth) if pose is not None], []
    poses = np.array([truth[row] for row in rows])
    for row in rows:
        older = poses[: np.searchsorted(rows, row - min_gap, side="right")]
        if len(older):
            distances, angles = pose_difference(truth[row], older)
            if ((distances <= PLACE_M) & (angles <= PLACE_DEG)).any():
                found.append(row)
    return found


def double_wall_share(
    means: np.ndarray, normals: np.ndarray, covs: np.ndarray, metre: float | None = 1.0
) -> float | None:
    """Share of Gaussians, in [0, 1], with another on a second layer; None for fewer than two.

    The other has a similar normal, lies nearer across than the Gaussians' spacing (median distance to the nearest), and
    along the normal between two standard deviations and 15 cm away, or four spacings without a metre. True surfaces so
    close behind another count too: compare maps of one scene.

    Lengths are in any unit; `metre` is one metre in it, None if unknown.
    """
    if len(means) < 2:
        return None
    tree = cKDTree(means)
    spacing = float(np.median(tree.query(means, k=2)[0][:, 1]))
    max_gap = MAX_GAP * spacing if metre is None else MAX_GAP_M * metre
    is_double = np.zeros(len(means), bool)
    for begin in range(0, len(means), _CHUNK):
        near = cKDTree(means[begin : begin + _CHUNK]).sparse_distance_matrix(
            tree, float(np.hypot(spacing, max_gap)), output_type="coo_matrix"
        )
        a, b = near.row + begin, near.col
        rows = np.flatnonzero((a < b) & (np.einsum("nd,nd->n", normals[a], normals[b]) > MIN_COS))
        a, b = a[rows], b[rows]
        doubled = _is_behind(means[b] - means[a], normals[a] + normals[b], (covs[a], covs[b]), spacing, max_gap)
        is_double[a[doubled]] = is_double[b[doubled]] = True
    return float(is_double.mean())


def _is_behind(
    offset: np.ndarray, normal: np.ndarray, covs: tuple[np.ndarray, np.ndarray], spacing: float, max_gap: float
) -> np.ndarray:
    """Test pairs (n,) for two layers, by their offset (n, 3), a normal of both (n, 3) and covariances (n, 3, 3)."""
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    gap = np.abs(np.einsum("nd,nd->n", offset, normal))
    across = np.sqrt(np.maximum(np.einsum("nd,nd->n", offset, offset) - gap**2, 0.0))
    std = np.sqrt(np.maximum(*(np.einsum("nd,nde,ne->n", normal, cov, normal) for cov in covs)))
    return (across < spacing) & (gap > MIN_STDS * std) & (gap < max_gap)
