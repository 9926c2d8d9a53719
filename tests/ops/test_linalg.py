"""Closed forms of small matrices against NumPy in float64, literals, and finite values where there is no answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.ops.linalg import (
    dot,
    gather_entries,
    gather_offsets,
    inverse_2x2,
    inverse_3x3,
    mahalanobis_sq,
    outer,
    principal_axes_2x2,
    safe_normalize,
    symmetrize,
    tangent_basis,
    whiten,
    whitening,
    widen,
)

RNG = np.random.default_rng(0)


def spd(count, dimension, stds):
    axes = np.linalg.qr(RNG.normal(size=(count, dimension, dimension)))[0]
    return np.einsum("nij,j,nkj->nik", axes, np.square(stds), axes)


@pytest.mark.parametrize("stds", [(0.1, 0.2, 0.3), (0.001, 0.05, 0.05), (30.0, 10.0, 20.0), (0.01, 0.01, 0.01)])
def test_inverse_and_whitening_equal_numpy_from_millimetres_to_decametres(stds):
    covs = spd(50, 3, stds)
    # Rounding the input alone moves the inverse by eps · condition number.
    tolerance = 1e-6 * (max(stds) / min(stds)) ** 2 + 1e-5
    expected = np.linalg.inv(covs)
    inverse = inverse_3x3(jnp.asarray(covs, jnp.float32))
    np.testing.assert_allclose(inverse, expected, atol=tolerance * np.abs(expected).max())
    triangle, logdet = whitening(jnp.asarray(covs, jnp.float32))
    lower = np.linalg.inv(np.linalg.cholesky(covs))[:, *np.tril_indices(3)]
    np.testing.assert_allclose(triangle, lower, atol=tolerance * np.abs(lower).max())
    np.testing.assert_allclose(logdet, np.linalg.slogdet(covs)[1], atol=3 * tolerance)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), -np.eye(3), np.diag([1.0, 1.0, -1.0])])
def test_a_matrix_that_is_not_positive_counts_as_the_identity(matrix):
    matrix = jnp.asarray(matrix, jnp.float32)
    np.testing.assert_array_equal(inverse_3x3(matrix), np.eye(3))
    triangle, logdet = whitening(matrix)
    np.testing.assert_array_equal(triangle, np.eye(3)[np.tril_indices(3)])
    assert logdet == 0
    for verb in (inverse_3x3, lambda m: whitening(m)[0]):
        assert np.isfinite(jax.grad(lambda m, verb=verb: jnp.sum(verb(m)))(matrix)).all()


def test_a_whitened_offset_has_the_mahalanobis_distance_also_with_noise_along_a_ray():
    covs, offsets, noise = spd(50, 3, (0.01, 0.1, 0.2)), *RNG.normal(size=(2, 50, 3)) * 0.1
    triangle, x, nu = (
        jnp.unstack(jnp.asarray(rows, jnp.float32), axis=-1)
        for rows in (whitening(jnp.asarray(covs, jnp.float32))[0], offsets, noise)
    )
    for white, cov in (
        (whiten(triangle, x), covs),
        (widen(whiten(triangle, x), whiten(triangle, nu)), covs + noise[:, :, None] * noise[:, None]),
    ):
        expected = np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(cov), offsets)
        np.testing.assert_allclose(dot(white, white), expected, rtol=1e-3)


def test_widening_is_the_symmetric_root_of_the_inverse_and_nothing_without_noise():
    """(I + u u')^(-1/2) by its eigenvectors; another root would have the same length, but turn or mirror offsets."""
    white, u = RNG.normal(size=(2, 20, 3))
    values, axes = np.linalg.eigh(np.eye(3) + u[:, :, None] * u[:, None])
    root = np.einsum("nij,nj,nkj->nik", axes, values**-0.5, axes)
    entries = [jnp.unstack(jnp.asarray(x, jnp.float32), axis=-1) for x in (white, u, 0.0 * u)]
    widened = jnp.stack(widen(entries[0], entries[1]), axis=-1)
    np.testing.assert_allclose(widened, np.einsum("nij,nj->ni", root, white), atol=1e-5)  # roundings of values near 1
    np.testing.assert_array_equal(jnp.stack(widen(entries[0], entries[2]), axis=-1), jnp.asarray(white, jnp.float32))


def test_entries_are_those_of_the_gathered_rows():
    table, rows = jnp.asarray(RNG.normal(size=(7, 3))), jnp.asarray(RNG.integers(0, 7, (4, 5)))
    np.testing.assert_array_equal(jnp.stack(gather_entries(table, rows), axis=-1), table[rows])
    points = jnp.asarray(RNG.normal(size=(4, 3)))
    expected = points[:, None] - table[rows]
    np.testing.assert_array_equal(jnp.stack(gather_offsets(points, table, rows), axis=-1), expected)


def test_the_inverse_of_2x2_equals_numpy_and_is_zero_where_singular():
    covs = spd(50, 2, (0.5, 20.0))
    expected = np.linalg.inv(covs)
    # Condition number 1600 times float32's eps.
    np.testing.assert_allclose(inverse_2x2(jnp.asarray(covs, jnp.float32)), expected, atol=3e-3)
    np.testing.assert_array_equal(inverse_2x2(jnp.ones((2, 2))), np.zeros((2, 2)))


def test_mahalanobis_is_squared_and_never_negative():
    assert mahalanobis_sq(jnp.array([2.0, 0, 3]), jnp.diag(jnp.array([1.0, 1, 4]))) == 40
    assert mahalanobis_sq(jnp.array([1.0, 0, 0]), -jnp.eye(3)) == 0


def test_a_direction_is_unit_and_zero_without_a_length_with_finite_gradients():
    vectors = jnp.array([[3.0, 0, 4], [0, 0, 0], [1e-13, 0, 0], [0, 1e-6, 0], [0, 0, -1e6]])
    expected = [[0.6, 0, 0.8], [0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, -1]]
    np.testing.assert_allclose(safe_normalize(vectors), expected, atol=1e-6)  # a few roundings
    assert np.isfinite(jax.grad(lambda v: safe_normalize(v).sum())(vectors)).all()


def test_symmetrize_and_outer_are_what_they_say():
    np.testing.assert_array_equal(symmetrize(jnp.array([[1.0, 2], [4, 3]])), [[1, 3], [3, 3]])
    np.testing.assert_array_equal(outer(jnp.array([1.0, 2, 3])), np.outer([1, 2, 3], [1, 2, 3]))


def test_a_tangent_basis_is_orthonormal_for_every_normal_poles_included():
    normals = np.concatenate([RNG.normal(size=(200, 3)), np.eye(3), -np.eye(3), [[1e-4, 0, -1]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    basis = np.asarray(tangent_basis(jnp.asarray(normals, jnp.float32)))
    frame = np.concatenate([basis, normals[..., None]], axis=-1)
    # The formula divides by 1 + |z| >= 1, so only roundings remain.
    np.testing.assert_allclose(
        np.einsum("nij,nik->njk", frame, frame), np.broadcast_to(np.eye(3), frame.shape), atol=1e-5
    )


def test_principal_axes_equal_numpy_larger_first():
    covs = spd(50, 2, (0.5, 1.5))
    axes = np.asarray(principal_axes_2x2(jnp.asarray(covs, jnp.float32)))
    expected = np.linalg.eigh(covs)[1][..., ::-1]
    cos = np.abs(np.einsum("nij,nij->nj", axes, expected))
    np.testing.assert_allclose(cos, 1.0, atol=1e-5)  # up to sign


def test_principal_axes_of_a_multiple_of_the_identity_are_the_coordinate_axes():
    np.testing.assert_array_equal(principal_axes_2x2(3.0 * jnp.eye(2)), np.eye(2))
    gradient = jax.grad(lambda m: principal_axes_2x2(m).sum())(jnp.eye(2))
    assert np.isfinite(gradient).all()
