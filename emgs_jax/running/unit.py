"""The unit of a map: that of the first inference during the run, and the mean of all inferences' at its end."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.geometry import Sim3
from emgs_jax.registration.pose_estimate import rescale_estimate
from emgs_jax.running.back_end import transform_nodes
from emgs_jax.running.convert import on_device
from emgs_jax.running.executables import stored
from emgs_jax.running.record import MappingRun, transform_record
from emgs_jax.slam import SlamState


def in_prior_unit(state: SlamState, origin: np.ndarray) -> SlamState:
    """Rescale a state by e^−γ about `origin`, so that the scales of all predictions are 1 on average.

    γ is the mean logarithm of the scales (`PoseEstimate.log_scale`): a length of a prediction times its scale is one of
    the map. The mean of all predictions errs by less than the first, which gave the map its unit. A state with γ = 0
    stays as it is.

    Args:
        state: after the last step.
        origin: (3,) of the first camera.
    """
    return rescaled(state, np.exp(-float(state.estimate.log_scale)), origin) if state.estimate.log_scale else state


def rescale_run(run: MappingRun) -> MappingRun:
    """Apply `in_prior_unit` to a run that ends, its records and its back end included.

    A saved map keeps its unit, and so does one of joined submaps: the mean is of the last one's inferences.
    """
    end = run.back_end
    if run.state is None or run.saved is not None or not run.state.estimate.log_scale:
        return run
    if end is not None and not end.has_one_unit:
        return run
    origin = next(record.pose for record in run.records if record.pose is not None)[:3, 3]  # the anchor's
    similarity = Sim3.about(origin, np.exp(-float(run.state.estimate.log_scale)))
    return replace(
        run,
        state=in_prior_unit(run.state, origin),
        records=tuple(transform_record(record, similarity) for record in run.records),
        back_end=end and transform_nodes(end, range(len(end.poses)), similarity),
    )


def rescaled(state: SlamState, factor: float, origin: np.ndarray) -> SlamState:
    """Multiply all lengths of a state by `factor`, about `origin`."""
    return _rescaled(state, *on_device((np.float32(factor), np.asarray(origin, np.float32))))


@stored
def _rescaled(state: SlamState, factor: Float[Array, ""], center: Float[Array, "3"]) -> SlamState:
    def placed(points: jnp.ndarray) -> jnp.ndarray:
        return center + factor * (points - center)

    def grown(map: GaussianMap) -> GaussianMap:
        gaussians = map.gaussians
        lengths = placed(gaussians.means), factor**2 * gaussians.covs
        return eqx.tree_at(lambda m: (m.gaussians.means, m.gaussians.covs), map, lengths)

    T = state.T_world_previous
    return replace(
        state,
        map=grown(state.map),
        previous=eqx.tree_at(lambda o: o.points, state.previous, placed(state.previous.points)),
        T_world_previous=jaxlie.SE3.from_rotation_and_translation(T.rotation(), placed(T.translation())),
        estimate=rescale_estimate(state.estimate, factor),
    )
