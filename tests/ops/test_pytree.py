"""Config fields and row operations against literals and plain NumPy indexing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scene import assert_same

from emgs_jax.ops.pytree import (
    choice,
    fill_rows,
    join_rows,
    put_rows,
    split_rows,
    static,
    take_rows,
    traced,
    where_rows,
)

ROWS = {"a": jnp.arange(4.0), "b": jnp.arange(12.0).reshape(4, 3)}


class Example(eqx.Module):
    threshold: Float[Array, "*b"] = traced()
    reading: Float[Array, "*b"] = choice("first", "second")
    size: int = static()


def test_an_integer_and_a_float_of_yaml_become_the_same_kind_of_leaf():
    one, other = Example(1, "first", 3), Example(1.0, 0, 3)
    assert_same(one, other)
    assert one.threshold.dtype == jnp.float32 and not one.threshold.weak_type


def test_a_choice_is_its_position_and_a_wrong_name_lists_the_right_ones():
    assert Example(1, "second", 3).reading == 1
    with pytest.raises(ValueError, match="first, second.*'third'"):
        Example(1, "third", 3)


def test_a_static_field_is_no_leaf():
    assert len(jax.tree.leaves(Example(1, "first", 3))) == 2


def test_taking_a_row_past_the_end_gives_the_last_row():
    taken = take_rows(ROWS, jnp.array([2, 0, 9]))
    np.testing.assert_array_equal(taken["a"], [2, 0, 3])
    np.testing.assert_array_equal(taken["b"], np.asarray(ROWS["b"])[[2, 0, 3]])


def test_putting_a_row_past_the_end_changes_nothing_and_others_are_written():
    values = jax.tree.map(lambda leaf: -leaf[:2] - 1, ROWS)
    put = put_rows(ROWS, jnp.array([4, 1]), values)
    np.testing.assert_array_equal(put["a"], [0, -2, 2, 3])
    np.testing.assert_array_equal(put["b"][1], [-4, -5, -6])
    np.testing.assert_array_equal(put["b"][jnp.array([0, 2, 3])], np.asarray(ROWS["b"])[[0, 2, 3]])


def test_where_chooses_whole_rows_even_against_nan():
    poisoned = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), ROWS)
    mask = jnp.array([True, False, True, False])
    chosen = where_rows(mask, ROWS, poisoned)
    np.testing.assert_array_equal(chosen["b"][::2], np.asarray(ROWS["b"])[::2])
    assert np.isnan(chosen["b"][1::2]).all() and np.isnan(chosen["a"][1::2]).all()


@pytest.mark.parametrize(
    ("num_rows", "max_rows", "shape"), [(7, 3, (3, 3)), (6, 3, (2, 3)), (4, 9, (1, 4)), (0, 3, (1, 0))]
)
def test_rows_cut_into_parts_and_joined_are_the_same_and_the_rest_is_zero(num_rows, max_rows, shape):
    tree = {"a": jnp.arange(1.0, num_rows + 1), "b": jnp.ones((num_rows, 2), bool)}
    parts = split_rows(tree, max_rows)
    assert parts["a"].shape == shape and parts["b"].shape == (*shape, 2)
    assert not parts["a"].reshape(-1)[num_rows:].any() and not parts["b"].reshape(-1, 2)[num_rows:].any()
    for joined, leaf in zip(jax.tree.leaves(join_rows(parts, num_rows)), jax.tree.leaves(tree), strict=True):
        np.testing.assert_array_equal(joined, leaf)


@pytest.mark.parametrize(("multiple", "num_rows"), [(1, 3), (2, 4), (3, 3), (5, 5)])
def test_rows_are_filled_up_to_the_next_multiple(multiple, num_rows):
    filled = np.asarray(fill_rows(ROWS["b"][:3], multiple, jnp.inf))
    np.testing.assert_array_equal(filled[:3], ROWS["b"][:3])
    assert filled.shape == (num_rows, 3) and np.isinf(filled[3:]).all()
