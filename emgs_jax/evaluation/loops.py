"""Are loops right, and are all of them found: against the true poses."""

from collections.abc import Sequence

import numpy as np

from emgs_jax.evaluation.trajectory import rotation_angles

PLACE_M, PLACE_DEG = 1.0, 30.0  # two frames that are nearer than this show one place
RIGHT_M, RIGHT_DEG = 0.3, 10.0  # a loop that errs by more is false
REACH = 10  # frames by which a loop beside them finds the others of a visit


def loop_metrics(
    loops: Sequence[tuple[int, int, np.ndarray]], truth: Sequence[np.ndarray | None], min_gap: int
) -> dict[str, float | int | None]:
    """Precision and recall of loops, `None` where there is nothing to be right or to be found.

    A loop is right where its measured motion is the true one up to 30 cm and 10°. A frame comes back where it is within
    1 m and 30° of one at least `min_gap` frames older; it is found where a right loop begins within 10 frames of it.
    Where only loops begin there that nobody can judge, as those into a saved map, it counts neither way.

    Args:
        loops: frames a and b and the measured pose of camera b in camera a, metres, (4, 4).
        truth: T_world_camera (4, 4) of every frame; None where unknown.
        min_gap: frames between a place and a return to it.
    """
    judged = [(b, _is_right(measured, truth[a], truth[b])) for a, b, measured in loops if _known(truth, a, b)]
    right = [b for b, is_right in judged if is_right]
    returning = _returning(truth, min_gap)
    unjudged = [b for a, b, _ in loops if not _known(truth, a, b)]
    found = [_is_near(row, right) for row in returning if _is_near(row, right) or not _is_near(row, unjudged)]
    return {
        "loops/precision": len(right) / len(judged) if judged else None,
        "loops/recall": float(np.mean(found)) if found else None,
        "loops/returning_frames": len(returning),
    }


def _is_near(row: int, frames: Sequence[int]) -> bool:
    return any(abs(row - frame) <= REACH for frame in frames)


def _known(truth: Sequence[np.ndarray | None], *rows: int) -> bool:
    return all(truth[row] is not None for row in rows)


def _is_right(measured: np.ndarray, true_a: np.ndarray, true_b: np.ndarray) -> bool:
    error = np.linalg.inv(np.linalg.inv(true_a) @ true_b) @ measured
    angle = np.degrees(rotation_angles(error[None, :3, :3]))[0]
    return bool(np.linalg.norm(error[:3, 3]) <= RIGHT_M and angle <= RIGHT_DEG)


def _returning(truth: Sequence[np.ndarray | None], min_gap: int) -> list[int]:
    """Frames that see a place again."""
    rows = np.array([row for row, pose in enumerate(truth) if pose is not None], int)
    if not len(rows):
        return []
    poses = np.stack([truth[row] for row in rows])
    found = []
    for position, row in enumerate(rows):
        older = poses[rows <= row - min_gap]
        near = np.linalg.norm(older[:, :3, 3] - poses[position, :3, 3], axis=1) <= PLACE_M
        turned = rotation_angles(np.swapaxes(older[near, :3, :3], 1, 2) @ poses[position, :3, :3])
        if (np.degrees(turned) <= PLACE_DEG).any():
            found.append(int(row))
    return found
