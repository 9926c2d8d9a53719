"""Compare an estimated trajectory with the true one: association, alignment, absolute and relative errors (RMS).

Poses are `T_world_camera`, float (n, 4, 4), in metres.
"""

import numpy as np

from emgs_jax.data.pose_conventions import EXPECTED, READINGS
from emgs_jax.data.timestamps import nearest_rows, resolution
from emgs_jax.geometry import Sim3, nearest_rotation, pose_difference, similarity_of

MIN_ODD_DEG, MIN_GAIN = 1.0, 3.0  # rotation per motion, and factor by which another convention must fit better
_MAX_ROLL_STD = 0.25  # rad; above, orientations determine the roll about a path better than its positions
_MIN_SPREAD_M = 1e-6  # RMS distance from its centroid below which a path has no direction and no scale


class DegenerateTrajectoryError(ValueError):
    """The positions do not determine the alignment."""


def associate(times_a: np.ndarray, times_b: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Pair timestamps (n,) and (m,), in seconds, that are each other's nearest within `max_difference` and rounding.

    Returns indices into a and into b, int (k,), in the order of a; none occurs twice.
    """
    times_a, times_b = np.asarray(times_a, np.float64), np.asarray(times_b, np.float64)
    if not len(times_a) or not len(times_b):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    to_b, to_a = _nearest(times_a, times_b), _nearest(times_b, times_a)
    rows = np.arange(len(times_a))
    keep = (to_a[to_b] == rows) & (np.abs(times_a - times_b[to_b]) <= max_difference + resolution(times_a, times_b))
    return rows[keep], to_b[keep]


def align(estimate: np.ndarray, reference: np.ndarray, with_scale: bool) -> Sim3:
    """Find the least-squares similarity, or rigid motion, from points (n, 3) to their partners (Umeyama 1991).

    The roll about a straight path is arbitrary; `align_poses` takes it from the orientations. Raises
    DegenerateTrajectoryError.
    """
    estimate, reference = _checked(estimate, reference, 3)
    for name, points in (("estimate", estimate), ("reference", reference)):
        if with_scale and _spread(points) < _MIN_SPREAD_M:
            raise DegenerateTrajectoryError(f"the {name} does not move: no scale can be estimated")
    return similarity_of(estimate, reference, with_scale=with_scale)


def align_poses(estimate: np.ndarray, truth: np.ndarray, with_scale: bool) -> tuple[Sim3, str | None]:
    """Align poses (n, 4, 4) by their positions, or by their orientations where positions leave something open.

    On a straight path the orientations determine the roll; without motion, or with fewer than 3 poses, they determine
    the rotation, and the scale is 1. The second value notes that; None in the regular case.
    """
    x, y = _checked(np.asarray(estimate)[:, :3, 3], np.asarray(truth)[:, :3, 3], 1)
    orientations = np.einsum("nij,nkj->ik", np.asarray(truth)[:, :3, :3], np.asarray(estimate)[:, :3, :3]) / len(x)
    if len(x) < 3 or min(_spread(x), _spread(y)) < _MIN_SPREAD_M:
        found = similarity_of(x, y, nearest_rotation(orientations), with_scale=False)
        return found, f"{len(x)} poses without enough motion: aligned by orientation"
    u, singular, vt = np.linalg.svd((y - y.mean(0)).T @ (x - x.mean(0)) / len(x))
    found = similarity_of(x, y, with_scale=with_scale)
    # n positions of error σ determine the roll about their line to σ / (w √n), where w is their spread beside it.
    least = ate(x, y, found) ** 2 / (len(x) * _MAX_ROLL_STD**2)
    if singular[1] > max(1e-6 * singular[0], least):
        return found, None
    # The spread beside the line is noise. A term too small to turn the line determines the roll.
    line = singular[0] * np.outer(u[:, 0], vt[0])
    rotation = nearest_rotation(line + 1e-5 * singular[0] * orientations)
    return similarity_of(x, y, rotation, with_scale), "straight path: roll about it aligned by orientation"


def ate(estimate: np.ndarray, reference: np.ndarray, alignment: Sim3) -> float:
    """RMS distance [m] of the aligned positions (n, 3) from the reference (n, 3)."""
    return _rms(np.linalg.norm(alignment.apply(estimate) - reference, axis=-1))


def rpe(estimate: np.ndarray, truth: np.ndarray, frames: np.ndarray | None = None) -> tuple[float, float]:
    """RMS translation [m] and rotation [deg] of the error from each pose to the next, at the estimate's own scale.

    Args:
        estimate: poses (n, 4, 4).
        truth: likewise.
        frames: number of each pose's frame (n,): where frames between two are missing, these do not count. None: all
            poses follow each other.

    Raises:
        DegenerateTrajectoryError: no two frames follow each other.
    """
    follows = np.ones(len(estimate) - 1, bool) if frames is None else np.diff(frames) == 1
    if not follows.any():
        raise DegenerateTrajectoryError("no two frames with a pose follow each other")
    motions = (np.linalg.inv(path[:-1][follows]) @ path[1:][follows] for path in (truth, estimate))
    distances, angles = pose_difference(*motions)
    return _rms(distances), _rms(angles)


def trajectory_metrics(
    estimate: np.ndarray, truth: np.ndarray, frames: np.ndarray | None = None
) -> dict[str, float | int | str | None]:
    """Compare poses (n, 4, 4) row by row; flat keys; None where undefined, with `trajectory/reason`.

    `frames` are the numbers of their frames, see `rpe`.
    """
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if estimate.shape != truth.shape or estimate.shape[1:] != (4, 4):
        raise ValueError(f"poses must be two equal (n, 4, 4), got {estimate.shape} and {truth.shape}: associate first")
    names = ("ate_sim3_m", "ate_se3_m", "scale", "scale_percent", "rpe_translation_m", "rpe_rotation_deg")
    metrics: dict[str, float | int | str | None] = dict.fromkeys(f"trajectory/{name}" for name in names)
    metrics["trajectory/num_frames"] = len(estimate)
    try:
        _checked(estimate.reshape(-1, 16), truth.reshape(-1, 16), 2)
        if frames is None or (np.diff(frames) == 1).any():
            errors = rpe(estimate, truth, frames)
            metrics["trajectory/rpe_translation_m"], metrics["trajectory/rpe_rotation_deg"] = errors
        x, y = estimate[:, :3, 3], truth[:, :3, 3]
        metrics["trajectory/ate_se3_m"] = ate(x, y, align(x, y, with_scale=False))
        similarity = align(x, y, with_scale=True)
    except DegenerateTrajectoryError as error:
        metrics["trajectory/reason"] = str(error)
        return metrics
    metrics["trajectory/ate_sim3_m"] = ate(x, y, similarity)
    scale = similarity.scale
    metrics["trajectory/scale"] = scale
    metrics["trajectory/scale_percent"] = 100.0 * min(scale, 1.0 / scale) if scale > 0 else 0.0
    return metrics


def check_conventions(estimate: np.ndarray, truth: np.ndarray, source: str) -> None:
    """Raise ValueError if poses (n, 4, 4) turn like the true ones in another convention, and not as they are."""
    if len(estimate) < 3:
        return
    own = rpe(estimate, truth)[1]
    found = {words: rpe(np.stack([change(pose) for pose in estimate]), truth)[1] for words, change in READINGS.items()}
    best = min(found, key=lambda words: found[words])
    if own > MIN_ODD_DEG and found[best] < own / MIN_GAIN:
        raise ValueError(
            f"{source}: the motions from pose to pose turn by {own:.1f} degrees otherwise than the true ones, and by "
            f"{found[best]:.1f} where the poses are taken as {best}: expected are {EXPECTED}"
        )


def _checked(estimate: np.ndarray, reference: np.ndarray, minimum: int) -> tuple[np.ndarray, np.ndarray]:
    estimate, reference = np.asarray(estimate, np.float64), np.asarray(reference, np.float64)
    if estimate.shape != reference.shape:
        raise ValueError(f"estimate {estimate.shape} and reference {reference.shape} must match: associate first")
    if len(estimate) < minimum:
        raise DegenerateTrajectoryError(f"{len(estimate)} poses, at least {minimum} are needed")
    if not (np.isfinite(estimate).all() and np.isfinite(reference).all()):
        raise DegenerateTrajectoryError("a pose is not finite")
    return estimate, reference


def _nearest(queries: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Index of the value nearest to each query; the smaller wins a tie."""
    order = np.argsort(values, kind="stable")
    return order[nearest_rows(queries, values[order], np.inf)]


def _spread(points: np.ndarray) -> float:
    return _rms(np.linalg.norm(points - points.mean(0), axis=-1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
