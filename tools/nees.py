"""`python -m tools.nees --runs 6`: map rooms and compare errors of poses with their covariances.

With words of a run, such as `dataset=apartment graph=default`, that sequence is mapped instead, with other seeds of the
prior each time. A run counts as one sample, since the errors of its frames depend on each other. The exit status is 1
where the mean of NEES / 6 (Bar-Shalom's x'P⁻¹x) is outside of the 95 % band of so many samples.
"""

import argparse
import sys

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import emgs_jax
from emgs_jax.mapping.run import MappingRun


def pose_errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """ξ (n, 6) of poses (n, 4, 4): T_true = T_estimated Exp(ξ), to first order; translation, then rotation."""
    difference = np.linalg.inv(estimated) @ true
    return np.concatenate([difference[:, :3, 3], Rotation.from_matrix(difference[:, :3, :3]).as_rotvec()], axis=1)


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """x'P⁻¹x / d (n,) of errors (n, d): one on average where the covariances (n, d, d) are theirs."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]) / errors.shape[1]


def errors_of_run(run: MappingRun) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 6) and covariances (n, 6, 6) of the tracked frames, relative to the first frame."""
    first = run.records[0]
    known = [record for record in run.records if record.status == "tracked" and record.covariance is not None]
    ours = np.linalg.inv(first.pose) @ np.stack([record.pose for record in known])
    truth = np.linalg.inv(first.true_pose) @ np.stack([record.true_pose for record in known])
    return pose_errors(ours, truth), np.stack([record.covariance for record in known])


def band(num_samples: int, share: float = 0.95) -> np.ndarray:
    """Ends (2,) between which the mean NEES / 6 of so many independent samples lies with probability `share`."""
    return chi2.ppf([(1 - share) / 2, (1 + share) / 2], 6 * num_samples) / (6 * num_samples)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.nees", description=__doc__)
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("words", nargs="*", help="instead of a room by seed")
    given = parser.parse_args()
    found = []
    for run in range(given.runs):  # the defaults were chosen with the prior's seeds 0, 1 and 2
        words = given.words or (f"dataset.seed={run}",)
        config = emgs_jax.load_config(f"prior.seed={run + 3}", "dataset.size=[160,120]", *words)
        errors, covs = errors_of_run(emgs_jax.map_sequence(config))
        found.append(nees(errors, covs).mean())
        parts = (nees(errors[:, part], covs[:, part, part]).mean() for part in (slice(3), slice(3, 6)))
        print(f"run {run}: {found[-1]:.2f}; translation {next(parts):.2f}, rotation {next(parts):.2f}", flush=True)
    low, high = band(len(found))
    print(f"mean {np.mean(found):.2f}; 95 % of such means lie between {low:.2f} and {high:.2f}")
    return int(not low <= np.mean(found) <= high)


if __name__ == "__main__":
    sys.exit(main())
