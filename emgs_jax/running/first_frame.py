"""Covariance of the first frame's own pose; the covariances of a run's poses are relative to that frame."""

from dataclasses import replace

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.localization import LocalizationConfig
from emgs_jax.observation import Observation, depth_in
from emgs_jax.registration.pose_estimate import PoseEstimate
from emgs_jax.registration.pose_noise import LEAST_NOISE, axis_std
from emgs_jax.running.executables import stored
from emgs_jax.running.record import MappingRun
from emgs_jax.slam import SlamState


def own_covariance(state: SlamState, config: LocalizationConfig) -> np.ndarray:
    """Estimate the covariance (6, 6) of the first frame's pose, in its own axes, from repeated predictions.

    The error of the first pose is in all later ones. It is not known when the map starts: only the repeated predictions
    of the whole run show how noisy the prior's poses are. 0 where no prediction has repeated another.

    Args:
        state: after the last step; m of its map.
        config: of the steps.
    """
    estimate, last = state.estimate, state.previous
    is_known = np.asarray(last.valid).any() and np.asarray(estimate.repeats.counts)[0] > 0
    if not is_known or float(config.pose_shared) >= 1:
        return np.zeros((6, 6))
    std = _own_std(estimate, last, state.T_world_previous, (config.icp.prior_information, config.pose_shared))
    return np.diag(np.asarray(std, np.float64) ** 2)


@stored
def _own_std(
    estimate: PoseEstimate,
    last: Observation,
    T_world_last: jaxlie.SE3,
    known: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, "6"]:
    mean_depth = jnp.mean(depth_in(T_world_last, last), where=last.valid)
    guess = jnp.maximum(estimate.depth_noise, LEAST_NOISE), mean_depth
    return axis_std(estimate.repeats, jnp.zeros((2, 2)), *guess, *known)[0]


def with_first_frame(run: MappingRun) -> MappingRun:
    """Add `own_covariance`, seen from each frame, to those of a run that ends; those in a saved map have none."""
    if run.state is None or run.saved is not None:
        return run
    own = own_covariance(run.state, run.config.localization)
    rows = [row for row, record in enumerate(run.records) if record.covariance is not None]
    if not rows or not own.any():
        return run
    first = next(record.pose for record in run.records if record.pose is not None)
    added = seen_from(own, first, np.stack([run.records[row].pose for row in rows]))
    records = list(run.records)
    for row, covariance in zip(rows, added, strict=True):
        records[row] = replace(records[row], covariance=records[row].covariance + covariance)
    return replace(run, records=tuple(records), first_covariance=own)


def seen_from(
    own: Float[np.ndarray, "6 6"], T_world_first: Float[np.ndarray, "4 4"], T_world_cameras: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 6 6"]:
    """Propagate the first frame's covariance to other poses: Ad own Adᵀ, each in its own axes."""
    T = np.linalg.inv(T_world_cameras) @ T_world_first
    rotations, across = T[:, :3, :3], np.cross(T[:, None, :3, 3], T[:, :3, :3], axisb=1, axisc=1)
    adjoints = np.block([[rotations, across], [np.zeros_like(rotations), rotations]])
    return adjoints @ own @ adjoints.transpose(0, 2, 1)
