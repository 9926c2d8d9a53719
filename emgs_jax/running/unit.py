"""The unit of a finished map: that of the first inference until then, and the mean of what all of them say at last."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.registration.belief import rescaled_belief
from emgs_jax.running.convert import on_device
from emgs_jax.running.executables import stored
from emgs_jax.running.record import MappingRun
from emgs_jax.slam import SlamState


def own_unit(state: SlamState, origin: np.ndarray) -> SlamState:
    """A state about whose map the prior says, on average, that it has the right size: scaled by e^−γ about `origin`.

    γ is the mean logarithm of the scales (`Belief.log_scale`). A length of an inference times its scale is one of the
    map, so that γ is what the map's unit, the first inference's, is short of the prior's own. One inference errs by its
    scale; their mean errs by less. A state with γ = 0 stays as it is.

    Args:
        state: after the last step.
        origin: (3,) of the first camera.
    """
    return rescaled(state, np.exp(-float(state.belief.log_scale)), origin) if state.belief.log_scale else state


def in_own_unit(run: MappingRun) -> None:
    """`own_unit` of a run that ends, its poses and those of the back end included.

    A saved map keeps its own, and so does one of segments that were joined: the mean is of the last one's inferences.
    """
    if run.state is None or run.saved is not None or not run.state.belief.log_scale:
        return
    if run.back_end is not None and not run.back_end.has_one_unit:
        return
    factor = np.exp(-float(run.state.belief.log_scale))
    origin = next(record.pose for record in run.records if record.pose is not None)[:3, 3]  # the anchor's

    def placed(pose: np.ndarray | None) -> np.ndarray | None:
        if pose is None:
            return None
        moved = pose.copy()
        moved[:3, 3] = origin + factor * (pose[:3, 3] - origin)
        return moved

    units = np.array([factor] * 3 + [1.0] * 3)
    run.state = own_unit(run.state, origin)
    run.records = [
        replace(
            record,
            pose=placed(record.pose),
            newest_pose=placed(record.newest_pose),
            covariance=None if record.covariance is None else units[:, None] * record.covariance * units,
            scale=None if record.scale is None else factor * record.scale,
        )
        for record in run.records
    ]
    if run.back_end is not None:
        run.back_end.poses = [placed(pose) for pose in run.back_end.poses]
        run.back_end.online = [placed(pose) for pose in run.back_end.online]
        run.back_end.log_scales = [float(np.log(factor)) + scale for scale in run.back_end.log_scales]


def rescaled(state: SlamState, factor: float, origin: np.ndarray) -> SlamState:
    """All lengths of a state times `factor`, about `origin`; the scales of later predictions follow."""
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
        belief=rescaled_belief(state.belief, factor),
    )
