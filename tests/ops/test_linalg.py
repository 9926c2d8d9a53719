"""Closed forms of small matrices against NumPy in float64, literals, and finite values where there is no answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import on_host

from emgs_jax.ops import linalg
from emgs_jax.ops.linalg import dot, gather_entries, gather_offsets, whiten, widen

inverse_2x2, mahalanobis_sq, outer, principal_axes_2x2, safe_normalize = (
    on_host(getattr(linalg, name))
    for name in ("inverse_2x2", "mahalanobis_sq", "outer", "principal_axes_2x2", "safe_normalize")
)
tangent_basis, whitening = on_host(linalg.tangent_basis), on_host(linalg.whitening)
RNG = np.random.default_rng(0)


def spd(count, dimension, stds):
    axes = np.linalg.qr(RNG.normal(size=(count, dimension, dimension)))[0]
    return np.einsum("nij,j,nkj->nik", axes, np.square(stds), axes)


@pytest.mark.parametrize("stds", [(0.1, 0.2, 0.3), (0.001, 0.05, 0.05), (30.0, 10.0, 20.0), (0.01, 0.01, 0.01)])
def test_whitening_equals_numpy_from_millimetres_to_decametres(stds):
    covs = spd(50, 3, stds)
    # Rounding the input alone moves the inverse by eps · condition number.
    tolerance = 1e-6 * (max(stds) / min(stds)) ** 2 + 1e-5
    triangle, logdet = whitening(np.float32(covs))
    lower = np.linalg.inv(np.linalg.cholesky(covs))[:, *np.tril_indices(3)]
    np.testing.assert_allclose(triangle, lower, atol=tolerance * np.abs(lower).max())
    np.testing.assert_allclose(logdet, np.linalg.slogdet(covs)[1], atol=3 * tolerance)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_matrix_that_is_not_positive_counts_as_the_identity(unit):
    mixed = [np.diag(np.roll([1.0, 1.0, -1.0], i)) for i in range(3)]
    matrices = np.float32([np.zeros((3, 3)), -np.eye(3), *mixed]) * np.float32(unit)
    triangles, logdets = whitening(matrices)
    np.testing.assert_array_equal(triangles, np.tile(np.eye(3)[np.tril_indices(3)], (len(matrices), 1)))
    np.testing.assert_array_equal(logdets, 0)
    total = lambda m: jnp.sum(linalg.whitening(m)[0])  # noqa: E731
    assert np.isfinite(on_host(jax.grad(total))(matrices)).all()


def entries(rows):
    return tuple(np.float32(rows).T)


def test_a_whitened_offset_has_the_mahalanobis_distance_also_with_noise_along_a_ray():
    covs, offsets, noise = spd(50, 3, (0.01, 0.1, 0.2)), *RNG.normal(size=(2, 50, 3)) * 0.1
    triangle, x, nu = entries(whitening(np.float32(covs))[0]), entries(offsets), entries(noise)
    widened = lambda triangle, x, nu: widen(whiten(triangle, x), whiten(triangle, nu))  # noqa: E731
    for white, cov in (
        (on_host(whiten)(triangle, x), covs),
        (on_host(widened)(triangle, x, nu), covs + noise[:, :, None] * noise[:, None]),
    ):
        expected = np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(cov), offsets)
        np.testing.assert_allclose(on_host(dot)(white, white), expected, rtol=1e-3)


def test_widening_is_the_symmetric_root_of_the_inverse_and_nothing_without_noise():
    """(I + u u')^(-1/2) by its eigenvectors; another root would have the same length, but turn or mirror offsets."""
    white, u = RNG.normal(size=(2, 20, 3))
    values, axes = np.linalg.eigh(np.eye(3) + u[:, :, None] * u[:, None])
    root = np.einsum("nij,nj,nkj->nik", axes, values**-0.5, axes)
    widened = np.stack(on_host(widen)(entries(white), entries(u)), axis=-1)
    np.testing.assert_allclose(widened, np.einsum("nij,nj->ni", root, white), atol=1e-5)  # roundings of values near 1
    still = on_host(widen)(entries(white), entries(0.0 * u))
    np.testing.assert_array_equal(np.stack(still, axis=-1), np.float32(white))


def test_entries_are_those_of_the_gathered_rows():
    table, points, rows = RNG.normal(size=(7, 3)), RNG.normal(size=(4, 3)), RNG.integers(0, 7, (4, 5))
    table, points = np.float32(table), np.float32(points)
    np.testing.assert_array_equal(np.stack(on_host(gather_entries)(table, rows), axis=-1), table[rows])
    found = on_host(gather_offsets)(points, table, rows)
    np.testing.assert_array_equal(np.stack(found, axis=-1), points[:, None] - table[rows])


def test_the_inverse_of_2x2_equals_numpy_and_is_zero_where_singular():
    covs = spd(50, 2, (0.5, 20.0))
    expected = np.linalg.inv(covs)
    # Condition number 1600 times float32's eps.
    np.testing.assert_allclose(inverse_2x2(np.float32(covs)), expected, atol=3e-3)
    np.testing.assert_array_equal(inverse_2x2(np.ones((2, 2), np.float32)), np.zeros((2, 2)))


def test_the_inverse_of_2x2_keeps_all_that_a_flat_covariance_says():
    """As float32 holds it: of widths of 1 and 1/3,000 the products of the determinant differ in their last digits."""
    covs = np.float32(spd(200, 2, (1.0, 1 / 3000)))
    covs[:, 1, 0] = covs[:, 0, 1]
    exact = np.linalg.inv(covs.astype(float))
    size = np.abs(exact).max(axis=(1, 2), keepdims=True)
    is_positive = np.linalg.det(covs.astype(float)) > 0  # rounded entries may be indefinite
    assert is_positive.mean() > 0.9
    np.testing.assert_allclose((inverse_2x2(covs) / size)[is_positive], (exact / size)[is_positive], atol=1e-5)


def test_a_floor_is_a_variance_more_and_outweighs_the_rounding_of_a_very_wide_covariance():
    covs, floored = spd(20, 3, (0.1, 0.2, 0.01)), on_host(linalg.floored)
    found = floored(np.float32(covs), np.float32(0.05))
    np.testing.assert_allclose(found, covs + 0.05**2 * np.eye(3), atol=1e-7)  # roundings of a 20th
    wide = np.float32(spd(200, 3, (1e3, 300.0, 0.0)))
    smallest = np.linalg.eigvalsh(floored(0.5 * (wide + wide.mT), np.float32(1e-3)).astype(float))[:, 0]
    assert (smallest > 0).all() and (smallest < 1.0).all()  # a part in a million of 1e6 m²


def test_mahalanobis_is_squared_and_never_negative():
    assert mahalanobis_sq(np.float32([2, 0, 3]), np.float32(np.diag([1, 1, 4]))) == 40
    assert mahalanobis_sq(np.float32([1, 0, 0]), np.float32(-np.eye(3))) == 0


def test_a_form_of_lower_entries_is_that_of_the_matrix():
    covs, vectors = spd(20, 3, (0.1, 0.2, 0.3)), RNG.normal(size=(20, 3))
    found = on_host(lambda s, v: linalg.quadratic(linalg.lower_entries(s), jnp.unstack(v, axis=-1)))
    np.testing.assert_allclose(
        found(*map(np.float32, (covs, vectors))), np.einsum("ni,nij,nj->n", vectors, covs, vectors), rtol=1e-4
    )


def test_a_direction_is_unit_and_zero_without_a_length_with_finite_gradients():
    vectors = np.float32([[3.0, 0, 4], [0, 0, 0], [1e-13, 0, 0], [0, 1e-6, 0], [0, 0, -1e6]])
    expected = [[0.6, 0, 0.8], [0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, -1]]
    np.testing.assert_allclose(safe_normalize(vectors), expected, atol=1e-6)  # a few roundings
    assert np.isfinite(on_host(jax.grad(lambda v: linalg.safe_normalize(v).sum()))(vectors)).all()


def test_outer_is_what_it_says():
    np.testing.assert_array_equal(outer(np.float32([1, 2, 3])), np.outer([1, 2, 3], [1, 2, 3]))


def test_a_tangent_basis_is_orthonormal_for_every_normal_poles_included():
    normals = np.concatenate([RNG.normal(size=(200, 3)), np.eye(3), -np.eye(3), [[1e-4, 0, -1], [1e-3, 0, 1]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    basis = tangent_basis(np.float32(normals))
    frame = np.concatenate([basis, normals[..., None]], axis=-1)
    # The formula divides by 1 + |z| >= 1, so only roundings remain.
    np.testing.assert_allclose(
        np.einsum("nij,nik->njk", frame, frame), np.broadcast_to(np.eye(3), frame.shape), atol=1e-5
    )


def test_principal_axes_equal_numpy_larger_first():
    covs = spd(50, 2, (0.5, 1.5))
    axes = principal_axes_2x2(np.float32(covs))
    expected = np.linalg.eigh(covs)[1][..., ::-1]
    cos = np.abs(np.einsum("nij,nij->nj", axes, expected))
    np.testing.assert_allclose(cos, 1.0, atol=1e-5)  # up to sign


def test_principal_axes_of_a_multiple_of_the_identity_are_the_coordinate_axes():
    round_one = np.float32(3.0 * np.eye(2))
    np.testing.assert_array_equal(principal_axes_2x2(round_one), np.eye(2))
    assert np.isfinite(on_host(jax.grad(lambda m: linalg.principal_axes_2x2(m).sum()))(round_one)).all()


@pytest.mark.parametrize("ratio", [10.0, 300.0, 3000.0])
def test_whitening_keeps_all_that_a_flat_covariance_says(ratio):
    """As float32 holds it: at 3,000 two deviations came out as 1.8 to 2.3, and at 10,000 it could be the identity."""
    covs = np.float32(spd(200, 3, (1.0, 0.7, 1.0 / ratio)))
    covs = 0.5 * (covs + covs.mT)
    across = np.linalg.eigh(covs.astype(float))[1][:, :, 0] * 2.0 / ratio
    white = np.stack(on_host(whiten)(entries(whitening(covs)[0]), entries(across)))
    exact = np.einsum("ni,nij,nj->n", np.float32(across).astype(float), np.linalg.inv(covs.astype(float)), across)
    np.testing.assert_allclose((white.astype(float) ** 2).sum(axis=0), exact, rtol=1e-5)  # a few roundings of offsets


def test_a_covariance_of_another_unit_whitens_to_another_unit():
    """By a power of two, which rounds nothing: flat ones, and ones that rounding has made a little negative."""
    covs = np.float32(spd(200, 3, (1.0, 0.7, 1e-5)))
    covs = 0.5 * (covs + covs.mT)
    covs[:3] = [np.diag(np.roll([1.0, 1.0, -1e-7], i)) for i in range(3)]
    triangle, logdet = whitening(covs)
    for power in (-10, 10):
        other, of_other = whitening(covs * np.float32(4.0**power))
        np.testing.assert_array_equal(other, triangle / np.float32(2.0**power))
        np.testing.assert_allclose(of_other - logdet, 6 * power * np.log(2), rtol=1e-6)


def test_a_covariance_flatter_than_float32_holds_is_flat_and_not_the_identity():
    flat = [np.diag(np.roll(variances, i)) for i in range(3) for variances in ([1.0, 0.7, 0.0], [1.0, 0.0, 0.0])]
    covs = np.concatenate([spd(500, 3, (1.0, 0.7, 1e-5)), flat])
    triangle = whitening(np.float32(0.5 * (covs + covs.mT)))[0]
    assert (triangle[:, [0, 2, 5]].max(axis=1) > 100).all()  # the last axis may lie nearly in the surface
