"""A map that follows its frames: every Gaussian moves with the frame of its birth."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.graph.measurements import Nodes
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import take_rows, where_rows
from emgs_jax.registration.rigid import pose_row


def _motions(before: Nodes, after: Nodes) -> tuple[Float[Array, "n 3 3"], Float[Array, "n"], Bool[Array, "n"]]:
    """Rotation and scale from one set of nodes to another, and which of them moved at all."""
    turn = (after.T_world.rotation() @ before.T_world.rotation().inverse()).as_matrix()
    is_same = jnp.all(before.T_world.wxyz_xyz == after.T_world.wxyz_xyz, axis=-1)
    has_moved = before.valid & ~(is_same & (before.log_scale == after.log_scale))
    return turn, jnp.exp(after.log_scale - before.log_scale), has_moved


@full_precision
def deform(map: GaussianMap, before: Nodes, after: Nodes, min_std: Float[Array, ""]) -> GaussianMap:
    """Move every Gaussian as the camera of its birth moved, its distance to it scaled like that inference.

    μ' = s ΔR (μ − t) + t', Σ' = s² ΔR (Σ − min_std² I) ΔRᵀ + min_std² I, n' = ΔR n, with ΔR = R' Rᵀ and s = e^{σ' − σ}:
    the scale acts in the old camera's frame, so that what the camera saw at a pixel stays at it.

    Args:
        map: world frame; `birth` is the row of a node.
        before: the nodes that the map conforms to.
        after: the same, where they are to be.
        min_std: m; the floor of the covariances, which is no length of the scene.

    Returns:
        The map; a Gaussian whose node did not move is the same bit for bit.
    """
    turns, scales, has_moved = take_rows(_motions(before, after), map.birth)
    old, new = (take_rows(nodes.T_world.translation(), map.birth) for nodes in (before, after))
    gaussians = map.gaussians
    means = jnp.einsum("nij,nj->ni", turns, scales[:, None] * (gaussians.means - old)) + new
    floor = min_std**2 * jnp.eye(3)
    shapes = jnp.einsum("nij,njk,nlk->nil", turns, gaussians.covs - floor, turns)
    normals = jnp.einsum("nij,nj->ni", turns, gaussians.normals)
    changed = means, scales[:, None, None] ** 2 * shapes + floor, normals
    moved = eqx.tree_at(lambda g: (g.means, g.covs, g.normals), gaussians, changed)
    moved = where_rows(has_moved & gaussians.valid, moved, gaussians)
    return eqx.tree_at(lambda m: m.gaussians, map, moved)


@full_precision
def deform_view(view: Observation, before: Nodes, after: Nodes, row: Int[Array, ""]) -> Observation:
    """A frame that was placed by node `row`, world frame, where that node is now; see `deform`."""
    _, scale, has_moved = (part[row] for part in _motions(before, after))
    old, new = (pose_row(nodes.T_world, row) for nodes in (before, after))
    moved = transform(new, transform(old.inverse(), view, jnp.ones(())), scale)
    return where_rows(has_moved & view.valid, moved, view)
