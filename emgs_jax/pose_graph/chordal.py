"""Initial poses for the solver: spread the error of every loop closure over its path, rotations first (chordal)."""

import jaxlie
import numpy as np
from jax import numpy as jnp

from emgs_jax.ops.precision import full_precision
from emgs_jax.pose_graph.factors import Nodes, PoseGraph
from emgs_jax.pose_graph.sparse import damped_step, normal_equations


@full_precision
def chordal_initialization(graph: PoseGraph, free: np.ndarray) -> Nodes | None:
    """Solve for the poses as two linear problems, independent of the current poses.

    First R_a Z = R_b for nine numbers each, projected back to rotations; then t_b − t_a = e^{σ_a} R_a z with these.
    Every measurement is weighted by the mean of its information on rotation or translation; scales stay.
    Source: Carlone et al., "Initialization techniques for 3D SLAM", 2015, section V.B.

    Args:
        graph: every factor in use and finite.
        free: (n, 7) unknowns that may change; the others keep their value.

    Returns:
        Nodes; None if a linear problem cannot be solved.
    """
    nodes, factors = graph.nodes, graph.factors
    ends = np.stack([factors.a, factors.b], axis=-1)
    information = np.sum(np.asarray(factors.sqrt_info) ** 2, axis=1)  # the diagonal
    rotations = np.asarray(nodes.T_world.rotation().as_matrix())
    turns = np.asarray(factors.Z_a_b.rotation().as_matrix())
    changed = _solve(
        ends,
        np.sqrt(np.mean(information[:, 3:6], axis=1))[:, None, None],
        turns.transpose(0, 2, 1),  # of R_aᵀ, so that the unknowns stand to the right
        rotations.transpose(0, 2, 1),
        np.zeros_like(rotations[factors.a]),
        free[:, 3:6],
    )
    if changed is None:
        return None
    u, _, vt = np.linalg.svd(changed.transpose(0, 2, 1))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations = np.where(free[:, 3, None, None], u @ vt, rotations)

    scaled = np.exp(np.asarray(nodes.log_scale))[factors.a, None] * np.asarray(factors.Z_a_b.translation())
    translations = _solve(
        ends,
        np.sqrt(np.mean(information[:, :3], axis=1))[:, None, None],
        np.ones((len(ends), 1, 1)),
        np.asarray(nodes.T_world.translation())[:, None],
        (rotations[factors.a] @ scaled[..., None]).transpose(0, 2, 1),
        free[:, :1],
    )
    if translations is None:
        return None
    turned = jaxlie.SO3.from_matrix(jnp.asarray(rotations))
    T = jaxlie.SE3.from_rotation_and_translation(turned, jnp.asarray(translations[:, 0]))
    poses = jnp.where(free[:, 3, None], T.wxyz_xyz, nodes.T_world.wxyz_xyz)
    return Nodes(jaxlie.SE3(poses), nodes.log_scale, nodes.valid)


def _solve(
    ends: np.ndarray,
    weights: np.ndarray,
    carry: np.ndarray,
    values: np.ndarray,
    offsets: np.ndarray,
    free: np.ndarray,
) -> np.ndarray | None:
    """Minimise weights · (carry x_a + offset − x_b) over x (n, d, c) in least squares, from the initial `values`."""
    a, b = ends.T
    errors = weights * (carry @ values[a] + offsets - values[b])
    degrees = values.shape[1]
    jacobians = weights * np.concatenate([carry, np.broadcast_to(-np.eye(degrees), carry.shape)], axis=-1)
    prior = np.zeros((*free.shape, 1 + values.shape[2]))
    step = damped_step(normal_equations(ends, errors, jacobians, free, prior), 0.0)
    if step is None or not np.isfinite(step).all():
        return None
    return values + step.reshape(values.shape)
