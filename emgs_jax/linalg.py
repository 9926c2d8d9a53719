"""Algebra of small symmetric matrices and directions, in closed form and with stated floors.

Every guard replaces the argument before the operation that would fail, never the result after it, so that gradients
stay finite too.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

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


def inverse_and_logdet(covs: Float[Array, "*b 3 3"]) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b"]]:
    """Inverse by the adjugate and log-determinant of symmetric positive matrices.

    The matrices are scaled to unit trace first, which keeps the determinant of a millimetre-thin Gaussian inside
    float32. A matrix that is not positive gives the inverse and the log-determinant of the identity.
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
    inverse = jnp.where(is_positive[..., None, None], inverse, jnp.eye(3, dtype=covs.dtype))
    logdet = jnp.where(is_positive, jnp.log(safe_det) + 3.0 * jnp.log(scale), 0.0)
    return inverse, logdet


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
