"""The k smallest of every column against a full sort."""

import jax
import numpy as np
import pytest

from emgs_jax.ops.k_smallest import smallest

select = jax.jit(smallest, static_argnums=1)


@pytest.mark.parametrize(("n", "k"), [(1, 1), (8, 8), (9, 8), (33, 16), (100, 17), (1000, 3)])
def test_the_rows_are_those_of_a_full_sort(n, k):
    values = np.stack([np.random.default_rng(n).permutation(n) for _ in range(70)], axis=1).astype(np.float32)
    np.testing.assert_array_equal(select(values, k), np.argsort(values, axis=0)[:k])


def test_values_are_told_apart_up_to_the_bits_that_carry_the_row():
    values = np.random.default_rng(0).uniform(0, 1, (128, 500)).astype(np.float32) ** 4
    rows = np.asarray(select(values, 16))
    found, expected = np.take_along_axis(values, rows, axis=0), np.sort(values, axis=0)[:16]
    assert all(len(set(column)) == 16 for column in rows.T)
    np.testing.assert_allclose(found, expected, rtol=128 * 2.0**-23)


def test_infinite_values_come_last_and_equal_ones_each_once():
    values = np.float32([np.inf, 2.0, np.inf, 0.0, 2.0, 2.0])[:, None]
    rows = np.asarray(select(values, 6))[:, 0]
    assert rows[0] == 3 and set(rows[1:4]) == {1, 4, 5} and set(rows[4:]) == {0, 2}


def test_an_accelerator_which_sorts_otherwise_finds_the_same(monkeypatch):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *operands, default, **_: default(*operands))
    values = np.stack([np.random.default_rng(i).permutation(60) for i in range(9)], axis=1).astype(np.float32)
    np.testing.assert_array_equal(jax.jit(lambda values: smallest(values, 7))(values), np.argsort(values, axis=0)[:7])
