"""Normalised estimation error squared (Bar-Shalom): x'P⁻¹x of an error x whose covariance is said to be P."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from emgs_jax.mapping.run import MappingRun

DEGREES = 6  # translation, rotation


def pose_errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """ξ (n, 6) of poses (n, 4, 4): T_true = T_estimated Exp(ξ), to first order."""
    difference = np.linalg.inv(estimated) @ true
    return np.concatenate([difference[:, :3, 3], Rotation.from_matrix(difference[:, :3, :3]).as_rotvec()], axis=1)


def nees(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Mean over the rows of x'P⁻¹x / 6: one where the covariances (n, 6, 6) are those of the errors (n, 6)."""
    return float(
        np.mean(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])) / DEGREES
    )


def nees_of_run(run: MappingRun) -> float:
    """`nees` of the tracked frames, relative to the first one, in metres as they are."""
    first = run.records[0]
    known = [record for record in run.records if record.status == "tracked" and record.covariance is not None]
    ours, truth = (
        np.linalg.inv(start) @ np.stack(poses)
        for start, poses in (
            (first.pose, [record.pose for record in known]),
            (first.true_pose, [record.true_pose for record in known]),
        )
    )
    return nees(pose_errors(ours, truth), np.stack([record.covariance for record in known]))


def band(num_samples: int, share: float = 0.95) -> tuple[float, float]:
    """Between which ends the mean NEES / 6 of so many independent samples lies with probability `share`."""
    low, high = chi2.ppf([(1 - share) / 2, (1 + share) / 2], DEGREES * num_samples) / (DEGREES * num_samples)
    return float(low), float(high)
