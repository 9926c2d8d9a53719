"""Config fields and row operations that every other file uses."""

from collections.abc import Sequence
from dataclasses import MISSING
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree, Shaped

from emgs_jax.ops.ranges import ranged

Tree = TypeVar("Tree")


def _as_float32(value: Any) -> Any:
    # Without the conversion, YAML's `1` and `1.0` would be two dtypes, and so two compilations.
    return value if isinstance(value, jax.ShapeDtypeStruct) else jnp.asarray(value, jnp.float32)


def traced(default: Any = MISSING, low: float | int | None = None, high: float | int | None = None) -> Any:
    """Declare a config field that is a traced number: changing it compiles nothing. Its range is as in `ops.ranges`."""
    return eqx.field(default=default, converter=_as_float32, metadata=ranged(low, high))


def choice(*names: str) -> Any:
    """Declare a traced config field, written as one of `names` and held as its index, so that readings can be swept."""

    def convert(value: Any) -> Any:
        return _as_float32(names.index(_one_of(names, value)) if isinstance(value, str) else value)

    return eqx.field(converter=convert, metadata={"choices": names})


def static_choice(*names: str, default: Any = MISSING) -> Any:
    """Declare a config field that chooses code, one of `names`: each compiles once."""
    return eqx.field(
        default=default, static=True, converter=lambda value: _one_of(names, value), metadata={"choices": names}
    )


def _one_of(names: Sequence[str], value: Any) -> str:
    if value not in names:
        raise ValueError(f"must be one of {', '.join(names)}; got {value!r}")
    return value


def static(default: Any = MISSING, low: float | int | None = None, high: float | int | None = None) -> Any:
    """Declare a config field that is a shape, a loop bound or a choice of code: each value compiles once."""
    return eqx.field(default=default, static=True, metadata=ranged(low, high))


def take_rows(tree: Tree, rows: Int[Array, "*r"]) -> Tree:
    """Take rows of every leaf; a row number past the end gives the last row, which the caller must mask."""
    return jax.tree.map(lambda leaf: jnp.take(leaf, rows, axis=0, mode="clip"), tree)


def put_rows(tree: Tree, rows: Int[Array, "r"], values: Tree) -> Tree:
    """Write `values` into `rows` of every leaf; a row number past the end is dropped."""
    return jax.tree.map(lambda leaf, value: leaf.at[rows].set(value, mode="drop"), tree, values)


def where_rows(mask: Bool[Array, "*n"], yes: Tree, no: Tree) -> Tree:
    """Choose whole rows (or pixels) by `mask`, whose axes are the first of every leaf."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(choose, yes, no)


def stack(trees: Sequence[Tree]) -> PyTree:
    """Stack the leaves of equal trees along a new first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def fill_rows(array: Shaped[Array, "n *c"], multiple: int, value: float | int) -> Shaped[Array, "m *c"]:
    """Append rows of `value` up to the next multiple of `multiple` rows."""
    beyond = ((0, -array.shape[0] % multiple), *[(0, 0)] * (array.ndim - 1))
    return jnp.pad(array, beyond, constant_values=value)


def split_rows(tree: Tree, max_rows: int) -> Tree:
    """Split the first axis of every leaf into equal parts of at most `max_rows`, a new first axis; zeros fill the last.

    Intermediate results of one part then fit into a CPU's cache. `join_rows` undoes it.
    """
    num_rows = jax.tree.leaves(tree)[0].shape[0]
    num_parts = max(-(-num_rows // max_rows), 1)

    def cut(leaf: Array) -> Array:
        filled = fill_rows(leaf, num_parts, 0)
        return filled.reshape(num_parts, filled.shape[0] // num_parts, *leaf.shape[1:])

    return jax.tree.map(cut, tree)


def join_rows(tree: Tree, num_rows: int) -> Tree:
    """Join the parts of `split_rows` and keep the first `num_rows` rows."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:num_rows], tree)
