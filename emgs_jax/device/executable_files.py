"""Files of kept executables: damage is noticed before anything is made of them, and JAX's cache removes old ones."""

import contextlib
import dataclasses
import hashlib
import importlib
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import jax

from emgs_jax.io.files import write_file

TRUSTED = ("emgs_jax.", "jaxlie.")  # whose classes a description may name


def _paths(folder: Path, name: str) -> tuple[Path, Path]:
    """A file and when it was used last, named as JAX's cache does, which removes what was not used for longest."""
    return tuple(folder / f"{name}-{what}" for what in ("cache", "atime"))


def read(folder: Path, name: str) -> bytes | None:
    """Content of a file that is whole."""
    path, used = _paths(folder, name)
    try:
        data = path.read_bytes()
    except OSError:  # not there, or not for this user
        return None
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        remove(folder, name, ValueError("it is damaged"))
        return None
    with contextlib.suppress(OSError):  # in a folder that may only be read
        used.write_bytes(time.time_ns().to_bytes(8, "little"))
    return zlib.decompress(data[32:])


def write(folder: Path, name: str, content: bytes) -> None:
    """Keep a file, with what tells that it is whole."""
    path, used = _paths(folder, name)
    data = zlib.compress(content, 1)
    with contextlib.suppress(OSError):  # a full disk keeps nothing, and is no failure
        used.write_bytes(time.time_ns().to_bytes(8, "little"))
        write_file(path, hashlib.sha256(data).digest() + data)


def remove(folder: Path, name: str, error: Exception) -> None:
    """Away with a file of which nothing can be made."""
    print(f"warning: an executable is compiled anew, {_paths(folder, name)[0]}: {error}", file=sys.stderr)
    for path in _paths(folder, name):
        with contextlib.suppress(OSError):
            path.unlink()


def described(node: Any) -> Any:
    """A tree of shapes as JSON.

    Raises:
        TypeError: there is something in it that `rebuilt` could not make again.
    """
    if isinstance(node, jax.ShapeDtypeStruct):
        return {"shape": node.shape, "dtype": node.dtype.name, "weak_type": node.weak_type}
    if node is None or isinstance(node, (bool, int, float, str)):
        return {"value": node}
    if type(node) in (tuple, list):
        return {type(node).__name__: [described(part) for part in node]}
    name = f"{type(node).__module__}:{type(node).__qualname__}"
    if not dataclasses.is_dataclass(node) or not name.startswith(TRUSTED):
        raise TypeError(name)
    return {
        "class": name,
        "fields": {one.name: described(getattr(node, one.name)) for one in dataclasses.fields(node)},
    }


def rebuilt(said: Any) -> Any:
    """The tree of a description."""
    match said:
        case {"shape": shape, "dtype": dtype, "weak_type": weak_type}:
            return jax.ShapeDtypeStruct(tuple(shape), dtype, weak_type=weak_type)
        case {"value": value}:
            return value
        case {"tuple": parts}:
            return tuple(map(rebuilt, parts))
        case {"list": parts}:
            return list(map(rebuilt, parts))
    module, name = said["class"].split(":")
    if not module.startswith(TRUSTED):
        raise ValueError(f"{module} is not of this package")
    kind = getattr(importlib.import_module(module), name)
    new = object.__new__(kind)
    for field, value in said["fields"].items():
        object.__setattr__(new, field, rebuilt(value))
    return new
