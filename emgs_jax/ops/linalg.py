"""Algebra of small symmetric matrices and directions, in closed form and with stated floors.

Every guard replaces the argument before the operation that would fail, never the result after it, so that gradients
stay finite too.
"""

from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Entries: TypeAlias = tuple[Float[Array, "..."], ...]
Whitening: TypeAlias = tuple[Float[Array, "n 6"], Float[Array, "n"]]  # what `whitening` gives for n covariances

# Below this length (m) a vector has no direction; far under any distance that is measured, far above float32's least.
SMALLEST_LENGTH = 1e-12


def safe_normalize(vectors: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    """Unit vectors; zero where the length is zero."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    is_long = squared > SMALLEST_LENGTH**2
    return jnp.where(is_long, vectors / jnp.sqrt(jnp.where(is_long, squared, 1.0)), 0.0)


def symmetrize(matrices: Float[Array, "*b d d"]) -> Float[Array, "*b d d"]:
    """The symmetric part."""
    return 0.5 * (matrices + jnp.swapaxes(matrices, -1, -2))


def outer(vectors: Float[Array, "*b d"]) -> Float[Array, "*b d d"]:
    """v v'."""
    return vectors[..., :, None] * vectors[..., None, :]


def inverse_3x3(covs: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Inverse by the adjugate of symmetric positive matrices; the identity where a matrix is not positive.

    The matrices are scaled to unit trace first, which keeps the determinant of a millimetre-thin Gaussian inside
    float32.
    """
    trace = jnp.trace(covs, axis1=-2, axis2=-1)
    scale = jnp.where(trace > 0, trace, 1.0)
    scaled = covs / scale[..., None, None]
    a, b, c = scaled[..., 0, :], scaled[..., 1, :], scaled[..., 2, :]
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    det = jnp.sum(a * adjugate[..., :, 0], axis=-1)
    is_positive = (det > 0) & (trace > 0)
    safe_det = jnp.where(is_positive, det, 1.0)
    inverse = symmetrize(adjugate) / (safe_det * scale)[..., None, None]
    return jnp.where(is_positive[..., None, None], inverse, jnp.eye(3, dtype=covs.dtype))


def whitening(covs: Float[Array, "*b 3 3"]) -> tuple[Float[Array, "*b 6"], Float[Array, "*b"]]:
    """W = L⁻¹ for the Cholesky factor Σ = L L', and log|Σ|; W x has unit covariance, and |W x|² = x' Σ⁻¹ x.

    Returns:
        The lower triangle of W, row by row, and the log-determinant; those of the identity where Σ is not positive.
    """
    trace = jnp.trace(covs, axis1=-2, axis2=-1)
    scale = jnp.where(trace > 0, trace, 1.0)
    a, b, c, d, e, f = (covs[..., row, column] / scale for row, column in zip(*jnp.tril_indices(3), strict=True))
    # Pivots d_i and unit factors of L D L'; every pivot is made positive before it divides.
    first = jnp.where(a > 0, a, 1.0)
    x, y = b / first, d / first
    second = c - b * x
    safe_second = jnp.where(second > 0, second, 1.0)
    z = (e - d * x) / safe_second
    third = f - d * y - (e - d * x) * z
    is_positive = (trace > 0) & (a > 0) & (second > 0) & (third > 0)
    safe_third = jnp.where(third > 0, third, 1.0)
    pivots = (first, safe_second, safe_third)
    i, j, k = (1.0 / jnp.sqrt(scale * pivot) for pivot in pivots)
    triangle = jnp.stack([i, -x * j, j, (x * z - y) * k, -z * k, k], axis=-1)
    logdet = sum(jnp.log(pivot) for pivot in pivots) + 3.0 * jnp.log(scale)
    identity = jnp.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], covs.dtype)
    return jnp.where(is_positive[..., None], triangle, identity), jnp.where(is_positive, logdet, 0.0)


def inverse_2x2(matrices: Float[Array, "*b 2 2"]) -> Float[Array, "*b 2 2"]:
    """Inverse of symmetric positive 2×2 matrices; zero where the determinant is not positive."""
    a, b, c = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    det = a * c - b * b
    is_positive = det > 0
    adjugate = jnp.stack([jnp.stack([c, -b], -1), jnp.stack([-b, a], -1)], -2)
    return jnp.where(is_positive[..., None, None], adjugate / jnp.where(is_positive, det, 1.0)[..., None, None], 0.0)


def mahalanobis_sq(offsets: Float[Array, "*#b d"], precisions: Float[Array, "*#b d d"]) -> Float[Array, "*b"]:
    """Squared Mahalanobis distance d' P d, never negative."""
    return jnp.maximum(jnp.einsum("...i,...ij,...j->...", offsets, precisions, offsets), 0.0)


# Vectors as tuples of their entries. Products of many 3-vectors are then one pass over all of them with the gathers
# inside, on a CPU about eight times as fast as `einsum` on gathered rows.


def gather_entries(table: Float[Array, "n c"], rows: Int[Array, "*b"]) -> Entries:
    """table[rows], entry by entry."""
    return tuple(column[rows] for column in jnp.unstack(table, axis=-1))


def gather_offsets(points: Float[Array, "m d"], table: Float[Array, "n d"], rows: Int[Array, "m k"]) -> Entries:
    """points[:, None] - table[rows], entry by entry."""
    entries = jnp.unstack(points[:, None], axis=-1)
    return tuple(a - b for a, b in zip(entries, gather_entries(table, rows), strict=True))


def down(vectors: Float[Array, "b q d"]) -> Entries:
    """Vectors of a block's q queries entry by entry, to meet the c vectors of `across`."""
    return tuple(entry[:, :, None] for entry in jnp.unstack(vectors, axis=-1))


def across(vectors: Float[Array, "b c d"]) -> Entries:
    """Vectors of the c things near a block, likewise."""
    return tuple(entry[:, None] for entry in jnp.unstack(vectors, axis=-1))


def between(first: Float[Array, "b q d"], second: Float[Array, "b c d"]) -> Entries:
    """first - second for every pair within each block, entry by entry."""
    return tuple(a - b for a, b in zip(down(first), across(second), strict=True))


def dot(first: Entries, second: Entries) -> Float[Array, "..."]:
    """Inner product."""
    return sum((a * b for a, b in zip(first, second, strict=True)), start=jnp.zeros(()))


def whiten(triangle: Entries, vector: Entries) -> Entries:
    """W x, for the triangle of `whitening`."""
    a, b, c, d, e, f = triangle
    x, y, z = vector
    return a * x, b * x + c * y, d * x + e * y + f * z


def widen(white: Entries, noise: Entries) -> Entries:
    """A whitened offset W x made white for the covariance Σ + ν ν', where `noise` is W ν.

    (I + u u')^(-1/2) = I - u u' / (s (s + 1)) with s² = 1 + u'u.
    """
    growth = jnp.sqrt(1.0 + dot(noise, noise))
    along = dot(white, noise) / (growth * (growth + 1.0))
    return tuple(w - along * u for w, u in zip(white, noise, strict=True))


def tangent_basis(normals: Float[Array, "*b 3"]) -> Float[Array, "*b 3 2"]:
    """Two unit vectors orthogonal to unit `normals` and to each other, without a singular direction but -z.

    Source: Duff et al., "Building an orthonormal basis, revisited", JCGT 2017.
    """
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(normals.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = jnp.stack([b, sign + y * y * a, -y], axis=-1)
    return jnp.stack([first, second], axis=-1)


def principal_axes_2x2(matrices: Float[Array, "*b 2 2"]) -> Float[Array, "*b 2 2"]:
    """Orthonormal eigenvectors as columns, larger eigenvalue first; the coordinate axes for a multiple of I."""
    a, b, c = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    is_isotropic = (jnp.abs(b) + jnp.abs(a - c)) <= 0
    angle = 0.5 * jnp.arctan2(jnp.where(is_isotropic, 0.0, 2.0 * b), jnp.where(is_isotropic, 1.0, a - c))
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)
