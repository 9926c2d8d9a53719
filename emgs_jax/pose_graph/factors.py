"""The pose graph: nodes, factors between them, and their residuals with derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import take_rows
from emgs_jax.registration.rigid import pose_row, scale_translation

DEGREES = 7  # of a node: translation, rotation (jaxlie's order), log-scale


class Nodes(eqx.Module):
    """One node for each integrated frame and its inference. The first valid one fixes the gauge: it never moves.

    Args:
        T_world: pose of the frame's camera, m in the map's scale.
        log_scale: σ: a length of the inference times e^σ is one of the map.
        valid: rows in use; the others may hold anything.
    """

    T_world: jaxlie.SE3
    log_scale: Float[Array, "n"]
    valid: Bool[Array, "n"]


class Factors(eqx.Module):
    """Factors: measurements of the similarity S_a⁻¹ S_b between two nodes.

    Args:
        a: row of the node whose inference measured.
        b: row of the node that was measured.
        Z_a_b: T_a⁻¹ T_b, its translation in the units of a's inference (the map's, times e^{−σ_a}).
        log_ratio: measured σ_b − σ_a: log of the median ratio of the same points' depths in a's inference and in b's.
        sqrt_info: W, with WᵀW the information of (translation, rotation, log-scale); a zero row is not measured.
        is_loop: measured by a loop closure, and so possibly an outlier; False for sequential, map and join factors.
        valid: rows in use; the others may hold anything. A factor of a node that is not in use is not used either.
    """

    a: Int[Array, "e"]
    b: Int[Array, "e"]
    Z_a_b: jaxlie.SE3
    log_ratio: Float[Array, "e"]
    sqrt_info: Float[Array, "e 7 7"]
    is_loop: Bool[Array, "e"]
    valid: Bool[Array, "e"]


class PoseGraph(eqx.Module):
    """Nodes and the factors between their rows."""

    nodes: Nodes
    factors: Factors


@full_precision
def move(nodes: Nodes, steps: Float[Array, "n 7"]) -> Nodes:
    """Perturb nodes from the right: T Exp(step) and σ + step; order translation, rotation, log-scale."""
    T = (nodes.T_world @ jaxlie.SE3.exp(steps[:, :6])).normalize()
    return Nodes(T, nodes.log_scale + steps[:, 6], nodes.valid)


def factors_in_use(graph: PoseGraph) -> Bool[Array, "e"]:
    """Find the factors that are valid and whose two nodes are."""
    nodes, factors = graph.nodes, graph.factors
    n = nodes.valid.shape[0]
    exists = (factors.a >= 0) & (factors.a < n) & (factors.b >= 0) & (factors.b < n)
    both = jnp.take(nodes.valid, factors.a, mode="clip") & jnp.take(nodes.valid, factors.b, mode="clip")
    return factors.valid & exists & both


def _residual(ends: Nodes, factor: Factors) -> Float[Array, "7"]:
    """Compute W (Log(Z⁻¹ (R_aᵀR_b, e^{−σ_a} R_aᵀ(t_b − t_a))), σ_b − σ_a − log_ratio) of a factor and its two nodes.

    It is in the inference's own units, so that a growing σ_a cannot lower the cost.
    """
    T_a_b = pose_row(ends.T_world, 0).inverse() @ pose_row(ends.T_world, 1)
    error = (factor.Z_a_b.inverse() @ scale_translation(T_a_b, jnp.exp(-ends.log_scale[0]))).log()
    return factor.sqrt_info @ jnp.append(error, ends.log_scale[1] - ends.log_scale[0] - factor.log_ratio)


def _with_ends(nodes: Nodes, factor: Factors, used: Bool[Array, ""]) -> tuple[Nodes, Factors]:
    """Return the two nodes of a factor, and the factor; neutral values if it is not in use."""
    ends = take_rows(nodes, jnp.where(used, jnp.stack([factor.a, factor.b]), 0))
    still = jnp.zeros_like(factor.Z_a_b.wxyz_xyz).at[0].set(1.0)
    zeros = jnp.zeros_like(factor.log_ratio), jnp.zeros_like(factor.sqrt_info)
    neutral_ends = Nodes(jaxlie.SE3(jnp.stack([still, still])), jnp.zeros_like(ends.log_scale), ends.valid)
    neutral = eqx.tree_at(lambda e: (e.Z_a_b.wxyz_xyz, e.log_ratio, e.sqrt_info), factor, (still, *zeros))
    return jax.tree.map(lambda x, y: jnp.where(used, x, y), (ends, factor), (neutral_ends, neutral))


@full_precision
def residuals(graph: PoseGraph) -> Float[Array, "e 7"]:
    """Compute the whitened residual of every factor, see `_residual`; 0 for a factor that is not in use."""

    def of_factor(factor: Factors, used: Bool[Array, ""]) -> Float[Array, "7"]:
        return _residual(*_with_ends(graph.nodes, factor, used))

    return jax.vmap(of_factor)(graph.factors, factors_in_use(graph))


@full_precision
def linearize(graph: PoseGraph) -> tuple[Float[Array, "e 7"], Float[Array, "e 7 14"]]:
    """Compute residuals and derivatives by the steps of `move` of nodes a and b; 0 for factors that are not in use."""

    def of_factor(factor: Factors, used: Bool[Array, ""]) -> tuple[Float[Array, "7"], Float[Array, "7 14"]]:
        ends, factor = _with_ends(graph.nodes, factor, used)

        def after(steps: Float[Array, "14"]) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
            residual = _residual(move(ends, steps.reshape(2, DEGREES)), factor)
            return residual, residual

        jacobian, residual = jax.jacfwd(after, has_aux=True)(jnp.zeros(2 * DEGREES, ends.log_scale.dtype))
        return residual, jacobian

    return jax.vmap(of_factor)(graph.factors, factors_in_use(graph))


def robust(
    chi2: Float[Array, "e"], is_loop: Bool[Array, "e"], kernel: Float[Array, ""]
) -> tuple[Float[Array, "e"], Float[Array, "e"]]:
    """Compute each factor's cost and the weight of its χ² in the quadratic model: dynamic covariance scaling on loops.

    ρ = χ²/2 up to φ, and 2φχ²/(φ + χ²) − φ/2 beyond, which never exceeds 3φ/2; weight s², s = min(1, 2φ/(φ + χ²)).
    Source: Agarwal et al., "Robust map optimization using dynamic covariance scaling", 2013; the kernel after MacTavish
    and Barfoot, "At all costs", 2015.

    Args:
        chi2: squared norm of the residuals.
        is_loop: loop factors; the others are quadratic.
        kernel: φ > 0; inf: quadratic.
    """
    excess = jnp.where(is_loop, chi2 / kernel, 0.0)
    scale = jnp.minimum(1.0, 2.0 / (1.0 + excess))
    return jnp.where(excess <= 1.0, 0.5 * chi2, scale * chi2 - 0.5 * kernel), scale**2
