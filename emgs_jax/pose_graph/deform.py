"""Deform a map with its poses: every Gaussian moves with the frames that made it and its neighbours."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import GaussianMap, transform_rows
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.neighbours import knn
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, take_rows, traced, where_rows
from emgs_jax.pose_graph.factors import Nodes
from emgs_jax.registration.rigid import pose_row


class DeformConfig(eqx.Module):
    """Over which Gaussians a motion is averaged, so that a surface from several frames has no seams.

    Args:
        num_neighbours: nearest Gaussians, including itself; 1: each moves only with the frame that made it.
        max_gap: largest number of nodes between the births of a Gaussian and a neighbour that counts; so two visits of
            a place move apart.
    """

    num_neighbours: int = static(9, low=1, high=256)
    max_gap: Float[Array, "*b"] = traced(40.0, low=0)


class _Motions(eqx.Module):
    """Similarities that move the surroundings of nodes from old to new poses: x' = s ΔR (x - t) + t'."""

    turn: jaxlie.SO3
    scale: Float[Array, "*n"]
    old: Float[Array, "*n 3"]
    new: Float[Array, "*n 3"]
    has_moved: Bool[Array, "*n"]

    def __call__(self, points: Float[Array, "*m 3"]) -> Float[Array, "*n 3"]:
        return self.new + self.scale[..., None] * (self.turn @ (points - self.old))


def _motions(before: Nodes, after: Nodes) -> _Motions:
    """Compute the motion of each node and whether it moved; a node that is not in use stays."""
    count = before.valid.shape[0]
    still = Nodes(jaxlie.SE3.identity((count,)), jnp.zeros(count), before.valid)
    before, after = (where_rows(before.valid, nodes, still) for nodes in (before, after))
    turn = after.T_world.rotation() @ before.T_world.rotation().inverse()
    is_same = jnp.all(before.T_world.wxyz_xyz == after.T_world.wxyz_xyz, axis=-1)
    has_moved = before.valid & ~(is_same & (before.log_scale == after.log_scale))
    scale = jnp.exp(after.log_scale - before.log_scale)
    return _Motions(turn, scale, before.T_world.translation(), after.T_world.translation(), has_moved)


@full_precision
def deform(
    map: GaussianMap, before: Nodes, after: Nodes, min_std: Float[Array, ""], config: DeformConfig
) -> GaussianMap:
    """Move every Gaussian with the cameras that made it and its neighbours.

    A node's motion is x' = s ΔR (x - t) + t' with ΔR = R' Rᵀ and s = e^{σ' - σ}. The scale acts in the old camera's
    frame, so that a point stays at its pixel. A Gaussian averages over the births of its neighbours: its position,
    μ' = mean x'_k(μ), and its rotation and scale, Σ' = s² ΔR (Σ - min_std² I) ΔRᵀ + min_std² I, n' = ΔR n. If all of
    them moved alike, it moves with them.

    Args:
        map: world frame; `birth` is the row of a node.
        before: the nodes to which the map conforms.
        after: the same nodes at their new poses.
        min_std: m; floor of the covariances, which does not scale with the scene.

    Returns:
        The map; if no node of its neighbourhood moved, a Gaussian is the same bit for bit.
    """
    gaussians = map.gaussians
    births, counts = _births(map, config)
    motions = take_rows(_motions(before, after), births)
    share = counts / jnp.sum(counts, axis=-1, keepdims=True)
    means = jnp.einsum("nk,nki->ni", share, motions(gaussians.means[:, None]))
    scale = jnp.exp(jnp.sum(share * jnp.log(motions.scale), axis=-1))
    moved = transform_rows(map, means, _mean_turn(motions.turn, share).as_matrix(), scale, min_std).gaussians
    has_moved = jnp.any(motions.has_moved & (counts > 0), axis=-1)
    moved = where_rows(has_moved & gaussians.valid, moved, gaussians)
    return eqx.tree_at(lambda m: m.gaussians, map, moved)


def _births(map: GaussianMap, config: DeformConfig) -> tuple[Int[Array, "n k"], Float[Array, "n k"]]:
    """Find the nodes that made a Gaussian and its neighbours, its own first, and 1 for those that count."""
    gaussians, own = map.gaussians, map.birth[:, None]
    num = min(config.num_neighbours, map.birth.shape[0])
    if num == 1:
        return own, jnp.ones(own.shape)
    rows, exists = knn(gaussians.means, gaussians.means, gaussians.valid, num, gaussians.valid)
    births = map.birth[rows]
    counts = exists & (rows != jnp.arange(len(rows))[:, None]) & (jnp.abs(births - own) <= config.max_gap)
    return jnp.concatenate([own, births], axis=1), jnp.pad(counts * 1.0, ((0, 0), (1, 0)), constant_values=1.0)


def _mean_turn(turns: jaxlie.SO3, share: Float[Array, "n k"]) -> jaxlie.SO3:
    """Average rotations that are near the first: align the signs of their quaternions, average, normalise."""
    sides = jnp.sign(jnp.einsum("nki,ni->nk", turns.wxyz, turns.wxyz[:, 0]))
    mean = jnp.einsum("nk,nki->ni", share * sides, turns.wxyz)
    return jaxlie.SO3(mean / jnp.linalg.norm(mean, axis=-1, keepdims=True))


@full_precision
def deform_view(view: Observation, before: Nodes, after: Nodes, row: Int[Array, ""]) -> Observation:
    """Move a frame (world frame) with its node `row`, see `deform`."""
    motions = _motions(before, after)
    old, new = (pose_row(nodes.T_world, row) for nodes in (before, after))
    moved = transform(new, transform(old.inverse(), view, jnp.ones(())), motions.scale[row])
    return where_rows(motions.has_moved[row] & view.valid, moved, view)
