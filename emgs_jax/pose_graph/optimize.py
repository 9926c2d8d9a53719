"""Pose-graph optimization, poses and scales: Levenberg–Marquardt on the host, in float64."""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.pytree import static, static_choice, traced
from emgs_jax.pose_graph.chordal import chordal_initialization
from emgs_jax.pose_graph.factors import DEGREES, Nodes, PoseGraph
from emgs_jax.pose_graph.problem import Linear, Problem, linear, moved, num_rows, problem_of
from emgs_jax.pose_graph.sparse import damped_step

# χ² of a measured row from which nothing can be gained: errors of a thousandth of their standard deviation.
NOTHING_TO_GAIN = 1e-6
LEAST_DAMPING, MAX_DAMPING = 1e-6, 1e8


class PoseGraphConfig(eqx.Module):
    """Settings of the pose-graph optimization: scale prior, robust kernel, start, convergence and acceptance.

    Args:
        scale_std: s_p: standard deviation of every σ about 0. 0: scales stay (SE(3)); inf: no prior, for predictions
            that are not metric. Scales of a metric model have errors of 3 %, shared by some 50 frames: .2.
        kernel: φ of dynamic covariance scaling on loop factors, in χ²; inf: quadratic.
        start: `current` poses, or `chordal`: errors spread over the paths if that costs less and, if a loop would be
            rejected, the solution with all loops at full weight.
        max_iterations: of Levenberg–Marquardt; 0: nothing moves.
        damping: initial λ, times the Hessian's diagonal; 0 is Gauss–Newton until a step fails.
        min_decrease: relative, of the cost; a smaller decrease means convergence.
        max_misfit: χ² per measured row of all factors but loops; a result that bends these more, and more than before,
            is refused.
    """

    scale_std: Float[Array, "*b"] = traced(0.2, low=0, high=math.inf)
    kernel: Float[Array, "*b"] = traced(16.8, low=1e-6, high=math.inf)  # χ²₆ at 99 %
    start: str = static_choice("current", "chordal", default="chordal")
    max_iterations: int = static(20, low=0, high=10000)
    damping: Float[Array, "*b"] = traced(1e-06, low=0)
    min_decrease: Float[Array, "*b"] = traced(1e-06, low=0, high=1)
    max_misfit: Float[Array, "*b"] = traced(25.0, low=0, high=math.inf)


@dataclass(frozen=True)
class PoseGraphInfo:
    """Result of a pose-graph optimization, also if it is refused and the nodes stay.

    Args:
        reason: why the nodes stay; empty if they moved or if there is nothing to gain.
        cost_before: Σρ over factors, and half the squared scale prior.
        cost: likewise, at the end.
        factor_chi2: (e,) χ² of every factor at the end, unweighted; 0 for a factor that is not in use.
        factor_weights: (e,) share of that χ² that counts: s² of dynamic covariance scaling, 1 for all but loops.
        dof: measured rows, including the scale prior, minus free unknowns.
        num_disconnected: nodes without a path to the gauge, which stay.
    """

    reason: str
    cost_before: float
    cost: float
    num_iterations: int
    converged: bool
    factor_chi2: np.ndarray
    factor_weights: np.ndarray
    dof: int
    num_disconnected: int


def _minimize(problem: Problem, now: Linear, config: PoseGraphConfig) -> tuple[Linear, int, bool]:
    """Minimise by Levenberg–Marquardt: return the best nodes, the number of tried steps, and whether it converged."""
    damping, kernel = float(config.damping), float(config.kernel)
    floor = NOTHING_TO_GAIN * sum(num_rows(problem.graph.factors))
    for iteration in range(config.max_iterations):
        enough = float(config.min_decrease) * (now.cost + floor)
        step = damped_step(now.equations, damping)
        if step is not None and np.isfinite(step).all():
            pull = damping * now.equations.hessian.diagonal()[:, None] * step - now.equations.gradient
            promised = 0.5 * np.sum(step * pull)
            trial = linear(problem, moved(now.nodes, step.reshape(-1, DEGREES)), kernel)
            gain = now.cost - trial.cost
            if gain > 0:  # not where it is NaN
                now, damping = trial, 0.1 * damping
            if promised <= enough or 0 < gain <= enough:
                return now, iteration + 1, True
            if gain > 0:
                continue
        damping = 10.0 * damping or LEAST_DAMPING
        if damping > MAX_DAMPING:
            return now, iteration + 1, False
    return now, config.max_iterations, False


def _info(
    problem: Problem, before: float, end: Linear, tried: tuple[int, bool], num_edges: int, reason: str = ""
) -> PoseGraphInfo:
    count = int(problem.used.sum())
    edge_chi2, edge_weights = np.zeros(num_edges), np.ones(num_edges)
    edge_chi2[problem.used], edge_weights[problem.used] = end.chi2[:count], end.weights[:count]
    num_prior = int(np.sum(problem.free[:, 6])) if problem.scale_information > 0 else 0
    return PoseGraphInfo(
        reason=reason,
        cost_before=before,
        cost=end.cost,
        num_iterations=tried[0],
        converged=tried[1],
        factor_chi2=edge_chi2,
        factor_weights=edge_weights,
        dof=sum(num_rows(problem.graph.factors)) + num_prior - int(np.sum(end.equations.measured)),
        num_disconnected=problem.num_disconnected,
    )


def _refused(graph: PoseGraph, reason: str) -> PoseGraphInfo:
    """Build the result of a graph that cannot be solved."""
    num_edges, nothing = graph.factors.a.shape[0], float("nan")
    zeros = np.zeros(num_edges)
    return PoseGraphInfo(reason, nothing, nothing, 0, False, zeros, np.ones(num_edges), 0, 0)


def _start(problem: Problem, initial: Linear, config: PoseGraphConfig) -> Linear:
    """Return the initial nodes, or those with errors spread over the paths, whichever costs less."""
    nodes = chordal_initialization(problem.graph, problem.free) if config.start == "chordal" else None
    if nodes is None:
        return initial
    other = linear(problem, nodes, float(config.kernel))
    return other if other.cost < initial.cost else initial


def _solve(problem: Problem, initial: Linear, config: PoseGraphConfig) -> tuple[Linear, int, bool]:
    """Search once; if that downweights a loop, search again from the solution with all loops at full weight.

    Returns the better result. The cost of a loop is bounded, so a loop that is strongly violated at the start would
    stay an outlier.
    """
    found = _minimize(problem, _start(problem, initial, config), config)
    is_loop = np.asarray(problem.graph.factors.is_loop)
    if config.start == "current" or not np.any(found[0].weights[is_loop] < 1):
        return found
    full = eqx.tree_at(lambda c: c.kernel, config, np.inf)
    start = linear(problem, problem.graph.nodes, np.inf)
    start = _minimize(problem, _start(problem, start, full), full)[0]
    other = _minimize(problem, linear(problem, start.nodes, float(config.kernel)), config)
    return other if other[0].cost < found[0].cost else found


def _rejection(problem: Problem, initial: Linear, end: Linear, converged: bool, config: PoseGraphConfig) -> str:
    """Return why a solution is rejected; empty if it is accepted."""
    if end is initial and not converged:
        return "no step lowers the cost"
    factors = problem.graph.factors
    is_other = ~np.asarray(factors.is_loop)
    allowed = float(config.max_misfit) * num_rows(factors)[1]
    bent = float(np.sum(end.chi2[is_other]))
    if bent > max(allowed, float(np.sum(initial.chi2[is_other]))):
        return f"the loops contradict the other factors: their χ² would be {bent:.4g}, more than {allowed:.4g}"
    return ""


def _write_back(nodes: Nodes, problem: Problem, end: Nodes) -> Nodes:
    """Write back the nodes that may move, in the given precision; the others stay bit for bit."""
    n = nodes.valid.shape[0]

    def put(old: Array, new: Array, free: np.ndarray) -> Array:
        return jnp.where(free.reshape(-1, *[1] * (old.ndim - 1)), jnp.asarray(new[:n], old.dtype), old)

    poses = put(nodes.T_world.wxyz_xyz, end.T_world.wxyz_xyz, problem.free[:n, 0])
    return Nodes(jaxlie.SE3(poses), put(nodes.log_scale, end.log_scale, problem.free[:n, 6]), nodes.valid)


def optimize(graph: PoseGraph, config: PoseGraphConfig) -> tuple[Nodes, PoseGraphInfo]:
    """Find the poses and scales of least Σρ(χ²) + Σ(σ/s_p)²/2; the first valid node stays.

    So do nodes without a path of measurements to it. Computes in float64, whatever the graph is stored in. Never
    raises: if the graph cannot be solved or there is nothing to gain, it returns the given nodes, and
    `PoseGraphInfo.reason` says why (empty if there is nothing to gain).
    """
    num_edges = graph.factors.a.shape[0]
    with jax.enable_x64(True):
        problem = problem_of(graph, float(config.scale_std))
        if isinstance(problem, str):
            return graph.nodes, _refused(graph, problem)
        initial = linear(problem, problem.graph.nodes, float(config.kernel))
        if not np.isfinite(initial.cost):
            return graph.nodes, _refused(graph, "the cost is not finite")
        is_settled = initial.cost <= NOTHING_TO_GAIN * sum(num_rows(problem.graph.factors))
        if is_settled or config.max_iterations == 0:
            return graph.nodes, _info(problem, initial.cost, initial, (0, is_settled), num_edges)
        end, num_iterations, converged = _solve(problem, initial, config)
        reason = _rejection(problem, initial, end, converged, config)
        info = _info(problem, initial.cost, end, (num_iterations, converged), num_edges, reason)
        keeps = bool(reason) or end is initial
        return graph.nodes if keeps else _write_back(graph.nodes, problem, end.nodes), info
