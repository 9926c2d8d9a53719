"""The graph that is solved: checked, in float64, padded, only the part with the gauge; and its linearisation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from emgs_jax.ops.pytree import where_rows
from emgs_jax.pose_graph.factors import DEGREES, Factors, Nodes, PoseGraph, factors_in_use, linearize, move, robust
from emgs_jax.pose_graph.sparse import NormalEquations, normal_equations


class Problem(NamedTuple):
    """The graph that is solved: float64, padded to powers of two, only the part with the gauge.

    Args:
        graph: padded; factors of other parts are not in use.
        free: (n, 7) unknowns that may change.
        scale_information: 1/s_p²; 0 without a prior.
        used: (e,) factors of the original graph that count.
        num_disconnected: nodes.
    """

    graph: PoseGraph
    free: np.ndarray
    scale_information: float
    used: np.ndarray
    num_disconnected: int


class Linear(NamedTuple):
    """The problem, linearised at some nodes."""

    nodes: Nodes
    cost: float
    chi2: np.ndarray
    weights: np.ndarray
    equations: NormalEquations


_linearize = jax.jit(linearize)
moved = jax.jit(move)
_robust = jax.jit(robust)


def _pad(array: object, count: int) -> np.ndarray:
    """Convert numbers to float64 and pad with rows of zeros up to `count`."""
    array = np.asarray(array)
    array = array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array
    return np.concatenate([array, np.zeros((count - len(array), *array.shape[1:]), array.dtype)])


def bucket(count: int) -> int:
    """Round up to a power of two, at least 64, so that a growing graph compiles rarely."""
    return max(64, 1 << (max(count, 1) - 1).bit_length())


def _parts(graph: PoseGraph, used: np.ndarray) -> np.ndarray:
    """Find the nodes (n,) in use with a path of measurements to the first one in use."""
    valid = np.asarray(graph.nodes.valid)
    joins = used & np.any(np.asarray(graph.factors.sqrt_info) != 0, axis=(1, 2))
    a, b = np.asarray(graph.factors.a)[joins], np.asarray(graph.factors.b)[joins]
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(valid), len(valid)))
    part = connected_components(links, directed=False)[1]
    return valid & (part == part[np.argmax(valid)])


def problem_of(graph: PoseGraph, scale_std: float) -> Problem | str:
    """Build the least-squares problem of a pose graph, or return the reason why it has no solution."""
    nodes, factors = graph.nodes, graph.factors
    used, valid = np.asarray(factors_in_use(graph)), np.asarray(nodes.valid)
    numbers = np.concatenate(
        [factors.Z_a_b.wxyz_xyz, np.asarray(factors.log_ratio)[:, None], np.asarray(factors.sqrt_info).reshape(-1, 49)],
        1,
    )
    bad = np.flatnonzero(used & ~np.isfinite(numbers).all(axis=1))
    if len(bad):
        return f"factors {bad[:5].tolist()} are not finite"
    poses = np.concatenate([nodes.T_world.wxyz_xyz, np.asarray(nodes.log_scale)[:, None]], 1)
    bad = np.flatnonzero(valid & ~np.isfinite(poses).all(axis=1))
    if len(bad):
        return f"nodes {bad[:5].tolist()} are not finite"
    if not used.any():
        return "no factor is in use"
    joined = _parts(graph, used)
    used = used & joined[np.asarray(factors.a) * used] & joined[np.asarray(factors.b) * used]
    if not used.any():
        return "no measurement leads to the first node"

    n, e = bucket(len(valid)), bucket(int(used.sum()))
    still = np.array(jaxlie.SE3.identity((n,)).wxyz_xyz, poses.dtype)
    still[: len(valid)][joined] = poses[joined, :7]
    scales = np.where(joined, poses[:, 7], 0.0)
    padded = jax.tree.map(lambda leaf: jnp.asarray(_pad(np.asarray(leaf)[used], e)), factors)
    padded = where_rows(padded.valid, padded, eqx.tree_at(lambda x: x.Z_a_b, padded, jaxlie.SE3.identity((e,))))
    moving = Nodes(jaxlie.SE3(jnp.asarray(still)), jnp.asarray(_pad(scales, n)), jnp.asarray(_pad(joined, n)))
    free = np.repeat(np.asarray(moving.valid)[:, None], DEGREES, axis=1)
    free[np.argmax(joined)] = False
    free[:, 6] &= scale_std > 0
    information = 1.0 / scale_std**2 if scale_std > 0 else 0.0
    return Problem(PoseGraph(moving, padded), free, information, used, int(np.sum(valid & ~joined)))


def linear(problem: Problem, nodes: Nodes, kernel: float) -> Linear:
    """Compute cost and normal equations at some nodes."""
    factors = problem.graph.factors
    residuals, jacobians = map(np.asarray, _linearize(PoseGraph(nodes, factors)))
    chi2 = np.sum(residuals**2, axis=1)
    costs, weights = map(np.asarray, _robust(chi2, factors.is_loop, kernel))
    root = np.sqrt(weights)[:, None, None]
    prior = np.zeros((*problem.free.shape, 2))
    prior[:, 6, 0] = problem.scale_information
    prior[:, 6, 1] = problem.scale_information * np.asarray(nodes.log_scale)
    ends = np.stack([factors.a, factors.b], axis=-1)
    equations = normal_equations(ends, root * residuals[..., None], root * jacobians, problem.free, prior)
    held = 0.5 * np.sum(problem.free[:, 6] * prior[:, 6, 1] * np.asarray(nodes.log_scale))
    return Linear(nodes, float(np.sum(costs) + held), chi2, weights, equations)


def num_rows(factors: Factors) -> tuple[int, int]:
    """Count the measured rows of the factors in use: of loops, and of all others."""
    counts = np.any(np.asarray(factors.sqrt_info) != 0, axis=2).sum(axis=1) * np.asarray(factors.valid)
    is_loop = np.asarray(factors.is_loop)
    return int(np.sum(counts[is_loop])), int(np.sum(counts[~is_loop]))
