"""Serialize structs (data classes, named tuples, mappings, sequences) as JSON and a few arrays; nothing is executed."""

import math
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def pack(value: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Describe a struct as JSON, and concatenate its arrays by type."""
    parts: dict[str, list[np.ndarray]] = {}
    sizes: dict[str, int] = {}

    def described(value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return str(value.value) if isinstance(value, Enum) else value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray | jax.Array):
            array = np.asarray(value)
            name, begin = array.dtype.str[1:], sizes.get(array.dtype.str[1:], 0)
            parts.setdefault(name, []).append(array.ravel())
            sizes[name] = begin + array.size
            return {"": [name, begin, list(array.shape), isinstance(value, jax.Array)]}
        if isinstance(value, Mapping):
            return {"": [[described(key), described(one)] for key, one in value.items()]}
        names = [field.name for field in fields(value)] if is_dataclass(value) else getattr(value, "_fields", ())
        if names:
            return {type(value).__name__: {name: described(getattr(value, name)) for name in names}}
        return [described(one) for one in value]

    said = described(value)
    return said, {name: np.concatenate(arrays) for name, arrays in parts.items()}


def unpack(said: Any, arrays: Mapping[str, np.ndarray], classes: Collection[type]) -> Any:
    """Rebuild what `pack` described, of these classes; sequences become tuples.

    Raises:
        ValueError, KeyError, TypeError: it is damaged.
    """
    by_name = {one.__name__: one for one in classes}

    def rebuilt(said: Any) -> Any:
        if isinstance(said, list):
            return tuple(map(rebuilt, said))
        if not isinstance(said, dict):
            return said
        ((name, content),) = said.items()
        if name:
            return by_name[name](**{field: rebuilt(value) for field, value in content.items()})
        if content and isinstance(content[0], str):
            kind, begin, shape, is_jax = content
            array = arrays[kind][begin : begin + math.prod(shape)].reshape(shape)
            return jnp.asarray(array) if is_jax else array
        return {rebuilt(key): rebuilt(value) for key, value in content}

    return rebuilt(said)
