"""Algebra of small symmetric matrices and directions, in closed form and with stated floors.

Every guard replaces the argument before an operation that would fail, never its result, so that gradients stay finite,
too.
"""

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Entries: TypeAlias = tuple[Float[Array, "..."], ...]
Whitening: TypeAlias = tuple[Float[Array, "n 6"], Float[Array, "n"]]  # result of `whitening` for n covariances

# Below this length (m) a vector has no direction; far below any measured distance, far above float32's smallest number.
SMALLEST_LENGTH = 1e-12
# Of a covariance's trace: rounding of its entries in float32, and the smallest variance that differs from 0.
ROUNDED, FLATTEST = 2.0**-22, 2.0**-28
ROUNDED_CORRELATION = 2.0**-18  # added to a diagonal of ones: rounding of so few rows may make it indefinite


def safe_normalize(vectors: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    """Normalise vectors to unit length; zero stays zero."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    is_long = squared > SMALLEST_LENGTH**2
    return jnp.where(is_long, vectors / jnp.sqrt(jnp.where(is_long, squared, 1.0)), 0.0)


def inner(first: Float[Array, "*b d"], second: Float[Array, "*#b d"]) -> Float[Array, "*b"]:
    """Compute the inner product of each pair of vectors."""
    return jnp.sum(first * second, axis=-1)


def outer(vectors: Float[Array, "*b d"]) -> Float[Array, "*b d d"]:
    """Compute v v'."""
    return vectors[..., :, None] * vectors[..., None, :]


def whitening(covs: Float[Array, "*b 3 3"]) -> tuple[Float[Array, "*b 6"], Float[Array, "*b"]]:
    """Compute W = L⁻¹ for the Cholesky factor Σ = L L', and log|Σ|; |W x|² = x' Σ⁻¹ x.

    Uses the leading minors of Σ. Their terms cancel if Σ is flat, so they are summed in twice the precision. Flatness
    is limited to what rounding of the entries can represent, a ratio of widths of some ten thousand.

    Returns:
        The lower triangle of W, row by row, and the log-determinant; those of the identity if a variance is negative or
        none is positive.
    """
    entries, logdet = whitened_entries(lower_entries(covs))
    return jnp.stack(entries, axis=-1), logdet


def lower_entries(matrices: Float[Array, "*b 3 3"]) -> Entries:
    """Take the lower triangles of 3×3 matrices, row by row, entry by entry."""
    # Transpose first; otherwise XLA extracts each entry wherever it occurs, four times as slow on a CPU.
    entries = jnp.unstack(matrices.reshape(*matrices.shape[:-2], 9), axis=-1)
    return tuple(jnp.copy(entries[place]) for place in (0, 3, 4, 6, 7, 8))


def whitened_entries(lower: Entries) -> tuple[Entries, Float[Array, "..."]]:
    """Compute `whitening` of lower triangles, entry by entry."""
    trace = lower[0] + lower[2] + lower[5]
    # A power of two, which rounds no entry.
    scale = jax.lax.stop_gradient(jax.lax.reduce_precision(jnp.where(trace > 0, trace, 1.0), 8, 0))
    least = jnp.minimum(jnp.minimum(lower[0], lower[2]), lower[5])
    is_positive = (trace > 0) & (least >= -ROUNDED * scale)
    identity = (1.0, 0.0, 1.0, 0.0, 0.0, 1.0)
    a, b, c, d, e, f = (jnp.where(is_positive, x / scale, one) for x, one in zip(lower, identity, strict=True))
    first = jnp.maximum(a, FLATTEST)
    # Of the last row of the adjugate, each a sum of two parts: x + y is the minor.
    of_d, of_e, of_f = minor_2x2(b, e, d, c), minor_2x2(d, b, e, first), minor_2x2(first, c, b, b)
    second = jnp.maximum(sum(of_f), first * FLATTEST)
    products = [two_product(x, y[0]) for x, y in ((d, of_d), (e, of_e), (f, of_f))]
    total, lost = two_sum(products[0][0], products[1][0])
    total, more = two_sum(total, products[2][0])
    det = total + (lost + more + sum(part[1] for part in products) + d * of_d[1] + e * of_e[1] + f * of_f[1])
    third = jnp.maximum(det, second * FLATTEST)
    unit = jnp.where(is_positive, scale, 1.0)
    i, j, k = (1.0 / jnp.sqrt(x) for x in (first, second, third))
    entries = i, -b * i * j, first * i * j, sum(of_d) * j * k, sum(of_e) * j * k, second * j * k
    return tuple(entry / jnp.sqrt(unit) for entry in entries), jnp.log(third) + 3.0 * jnp.log(unit)


def two_product(first: Float[Array, "*b"], second: Float[Array, "*b"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Compute a product and its rounding error (Dekker 1971); the error has no gradient."""
    product = first * second
    high, other_high = (jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=11) for x in (first, second))
    low, other_low = first - high, second - other_high
    lost = ((high * other_high - product) + high * other_low + low * other_high) + low * other_low
    return product, jax.lax.stop_gradient(lost)


def two_sum(first: Float[Array, "*b"], second: Float[Array, "*b"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Compute a sum and its rounding error (Knuth); the error has no gradient."""
    total = first + second
    part = total - first
    return total, jax.lax.stop_gradient((first - (total - part)) + (second - part))


def minor_2x2(
    a: Float[Array, "*b"], b: Float[Array, "*b"], c: Float[Array, "*b"], d: Float[Array, "*b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Compute a b - c d as a sum of two numbers, in twice the precision."""
    (one, lost), (other, more) = two_product(a, b), two_product(-c, d)
    total, rest = two_sum(one, other)
    return total, rest + lost + more


def floored(covs: Float[Array, "*b 3 3"], min_std: Float[Array, ""]) -> Float[Array, "*b 3 3"]:
    """Add a floor: Σ + σ² I with σ² = min_std², or more if a very wide Σ needs it to stay positive despite rounding."""
    trace = jnp.trace(covs, axis1=-2, axis2=-1)
    return covs + (min_std**2 + ROUNDED * trace)[..., None, None] * jnp.eye(3)


def inverse_2x2(matrices: Float[Array, "*b 2 2"]) -> Float[Array, "*b 2 2"]:
    """Invert symmetric positive 2×2 matrices; zero if the determinant is not positive."""
    a, b, c = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    det, rest = minor_2x2(a, c, b, b)
    det += rest
    is_positive = det > 0
    adjugate = jnp.stack([jnp.stack([c, -b], -1), jnp.stack([-b, a], -1)], -2)
    return jnp.where(is_positive[..., None, None], adjugate / jnp.where(is_positive, det, 1.0)[..., None, None], 0.0)


def mahalanobis_sq(offsets: Float[Array, "*#b d"], precisions: Float[Array, "*#b d d"]) -> Float[Array, "*b"]:
    """Compute the squared Mahalanobis distance d' P d, never negative."""
    return jnp.maximum(jnp.einsum("...i,...ij,...j->...", offsets, precisions, offsets), 0.0)


# Vectors as tuples of their entries: products of many 3-vectors are then one pass that includes the gathers, on a CPU
# about eight times as fast as `einsum` on gathered rows.


def gather_entries(table: Float[Array, "n c"], rows: Int[Array, "*b"]) -> Entries:
    """Gather table[rows], entry by entry."""
    return tuple(column[rows] for column in jnp.unstack(table, axis=-1))


def gather_offsets(points: Float[Array, "m d"], table: Float[Array, "n d"], rows: Int[Array, "m k"]) -> Entries:
    """Compute points[:, None] - table[rows], entry by entry."""
    entries = jnp.unstack(points[:, None], axis=-1)
    return tuple(a - b for a, b in zip(entries, gather_entries(table, rows), strict=True))


def down(vectors: Float[Array, "b q d"]) -> Entries:
    """Arrange the vectors of a block's q queries, entry by entry, to broadcast against the c of `across`."""
    return tuple(entry[:, :, None] for entry in jnp.unstack(vectors, axis=-1))


def across(vectors: Float[Array, "b c d"]) -> Entries:
    """Arrange the vectors of c items near a block, to broadcast against those of `down`."""
    return tuple(entry[:, None] for entry in jnp.unstack(vectors, axis=-1))


def between(first: Float[Array, "b q d"], second: Float[Array, "b c d"]) -> Entries:
    """Compute first - second for every pair within each block, entry by entry."""
    return tuple(a - b for a, b in zip(down(first), across(second), strict=True))


def dot(first: Entries, second: Entries) -> Float[Array, "..."]:
    """Compute the inner product."""
    return sum((a * b for a, b in zip(first, second, strict=True)), start=jnp.zeros(()))


def cross(first: Entries, second: Entries) -> Entries:
    """Compute the cross product."""
    (a, b, c), (x, y, z) = first, second
    return b * z - c * y, c * x - a * z, a * y - b * x


def whiten(triangle: Entries, vector: Entries) -> Entries:
    """Compute W x, for the triangle of `whitening`."""
    a, b, c, d, e, f = triangle
    x, y, z = vector
    return a * x, b * x + c * y, d * x + e * y + f * z


def widened_distance_sq(white: Entries, noise: Entries) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Compute the squared Mahalanobis distance under Σ + ν ν', and log|Σ + ν ν'| - log|Σ|, from whitened w and u = W ν.

    (|w|² + |w × u|²) / (1 + |u|²) has no cancellation, unlike |w|² - (w·u)² / (1 + |u|²) (Sherman–Morrison) for a
    distant point behind its Gaussian along ν.
    """
    growth = 1.0 + dot(noise, noise)
    turned = cross(white, tuple(entry / jnp.sqrt(growth) for entry in noise))
    return dot(white, white) / growth + dot(turned, turned), jnp.log(growth)


def quadratic(lower: Entries, vector: Entries) -> Float[Array, "..."]:
    """Compute x' Σ x, for the lower triangle of Σ."""
    a, b, c, d, e, f = lower
    x, y, z = vector
    return a * x * x + c * y * y + f * z * z + 2.0 * (b * x * y + d * x * z + e * y * z)


def widen(white: Entries, noise: Entries) -> Entries:
    """Whiten an offset W x further, for the covariance Σ + ν ν', where `noise` is W ν.

    (I + u u')^(-1/2) = I - u u' / (s (s + 1)) with s² = 1 + u'u.
    """
    growth = jnp.sqrt(1.0 + dot(noise, noise))
    along = dot(white, noise) / (growth * (growth + 1.0))
    return tuple(w - along * u for w, u in zip(white, noise, strict=True))


def tangent_basis(normals: Float[Array, "*b 3"]) -> Float[Array, "*b 3 2"]:
    """Make two unit vectors orthogonal to unit `normals` and to each other; singular only at -z.

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
    """Compute orthonormal eigenvectors as columns, larger eigenvalue first; the coordinate axes for a multiple of I."""
    a, b, c = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    is_isotropic = (jnp.abs(b) + jnp.abs(a - c)) <= 0
    angle = 0.5 * jnp.arctan2(jnp.where(is_isotropic, 0.0, 2.0 * b), jnp.where(is_isotropic, 1.0, a - c))
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)
