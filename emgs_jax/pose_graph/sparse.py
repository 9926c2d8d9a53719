"""Normal equations of measurements between pairs of nodes: sparse, in float64, on the host."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu


class NormalEquations(NamedTuple):
    """Hessian and gradient of ½|r|² by d unknowns of each of n nodes.

    Args:
        hessian: (n·d, n·d); 1 on the diagonal of an unknown that is fixed or not measured.
        gradient: (n·d, c), for c right-hand sides; 0 for these unknowns.
        measured: (n·d,) unknowns that are free and measured.
    """

    hessian: csc_array
    gradient: np.ndarray
    measured: np.ndarray


def normal_equations(
    ends: np.ndarray, residuals: np.ndarray, jacobians: np.ndarray, free: np.ndarray, prior: np.ndarray
) -> NormalEquations:
    """Sum JᵀJ and Jᵀr over all measurements.

    Args:
        ends: (e, 2) the two nodes of each measurement.
        residuals: (e, r, c), for c right-hand sides.
        jacobians: (e, r, 2d), by the unknowns of both.
        free: (n, d) unknowns that may change.
        prior: (n, d, 1 + c): information about each unknown alone, and its gradients.
    """
    num_nodes, degrees = free.shape
    unknowns = (ends[:, :, None] * degrees + np.arange(degrees)).reshape(len(ends), -1)
    jacobians = jacobians * free.ravel()[unknowns][:, None]
    transposed = jacobians.transpose(0, 2, 1)
    rows = np.broadcast_to(unknowns[:, :, None], (*unknowns.shape, unknowns.shape[1]))
    prior = (prior * free[..., None]).reshape(num_nodes * degrees, -1)
    size = num_nodes * degrees
    entries = (transposed @ jacobians).ravel(), (rows.ravel(), rows.transpose(0, 2, 1).ravel())
    hessian = coo_array(entries, shape=(size, size)).tocsc() + diags_array(prior[:, 0])
    gradient = prior[:, 1:]
    np.add.at(gradient, unknowns, transposed @ residuals)
    measured = hessian.diagonal() > 0
    return NormalEquations((hessian + diags_array(1.0 - measured)).tocsc(), gradient, measured)


def factorize(matrix: csc_array) -> SuperLU | None:
    """Factorize a symmetric positive definite matrix; None if it is singular."""
    try:
        # A positive definite matrix needs no pivoting, which would destroy the order that keeps the factors sparse.
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None


def damped_step(equations: NormalEquations, damping: float) -> np.ndarray | None:
    """Compute the Levenberg–Marquardt step −(H + λ diag H)⁻¹ g, (n·d, c); None if the matrix is singular."""
    factors = factorize((equations.hessian + diags_array(damping * equations.hessian.diagonal())).tocsc())
    return None if factors is None else factors.solve(-equations.gradient)
