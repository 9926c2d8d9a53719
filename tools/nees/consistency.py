"""Normalised estimation error squared (Bar-Shalom): x'P⁻¹x of an error x whose covariance is said to be P."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from emgs_jax.mapping.run import MappingRun

DEGREES = 6  # translation, rotation


def pose_errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """ξ (n, 6) of poses (n, 4, 4): T_true = T_estimated Exp(ξ), to first order."""
    difference = np.linalg.inv(estimated) @ true
    return np.concatenate([difference[:, :3, 3], Rotation.from_matrix(difference[:, :3, :3]).as_rotvec()], axis=1)


class Consistency(NamedTuple):
    """NEES over degrees of freedom, of all frames and by what they err in; one everywhere were all as it is said.

    Args:
        directions: (6,), by the principal axes of the correlations, the best known first.
        quarters: (4,), of the path; fewer where there are fewer frames.
    """

    mean: float
    median: float
    translation: float
    rotation: float
    directions: np.ndarray
    quarters: np.ndarray


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """x'P⁻¹x / d (n,) of errors (n, d): one on average where the covariances (n, d, d) are theirs."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]) / errors.shape[1]


def consistency(errors: np.ndarray, covariances: np.ndarray) -> Consistency:
    """`nees` of errors (n, 6) in the order of the path, and how it splits."""
    of_frames, std = nees(errors, covariances), np.sqrt(np.einsum("nii->ni", covariances))
    variances, axes = np.linalg.eigh(covariances / std[:, :, None] / std[:, None])
    return Consistency(
        float(of_frames.mean()),
        float(np.median(of_frames)),
        float(nees(errors[:, :3], covariances[:, :3, :3]).mean()),
        float(nees(errors[:, 3:], covariances[:, 3:, 3:]).mean()),
        np.mean(np.einsum("nij,ni->nj", axes, errors / std) ** 2 / variances, axis=0),
        np.array([part.mean() for part in np.array_split(of_frames, min(4, len(of_frames)))]),
    )


def consistency_of_run(run: MappingRun) -> Consistency:
    """`consistency` of the tracked frames, relative to the first one, in metres as they are."""
    first = run.records[0]
    known = [record for record in run.records if record.status == "tracked" and record.covariance is not None]
    ours, truth = (
        np.linalg.inv(start) @ np.stack(poses)
        for start, poses in (
            (first.pose, [record.pose for record in known]),
            (first.true_pose, [record.true_pose for record in known]),
        )
    )
    return consistency(pose_errors(ours, truth), np.stack([record.covariance for record in known]))


def band(num_samples: int, share: float = 0.95) -> tuple[float, float]:
    """Between which ends the mean NEES / 6 of so many independent samples lies with probability `share`."""
    low, high = chi2.ppf([(1 - share) / 2, (1 + share) / 2], DEGREES * num_samples) / (DEGREES * num_samples)
    return float(low), float(high)
