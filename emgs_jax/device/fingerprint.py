"""What functions compute, told from what is in memory: their code, its constants and all that it names.

A file says what was imported, not what runs: since then a notebook may have replaced a stage, and a store keyed by the
text of files would run the old one, or keep the new one for others. Packages of others are told by their versions, and
anything in them that was replaced by what it is now.
"""

import functools
import hashlib
import sys
import types
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import jax
import numpy as np

PACKAGES = ("jax", "jaxlib", "equinox", "jaxlie", "optimistix", "lineax", "jaxtyping", "numpy")
_PLAIN = (int, float, complex, str, bytes, type(None), type(Ellipsis), range, np.dtype, np.generic)
_KNOWN = {*PACKAGES, "ml_dtypes", "wadler_lindig", *sys.stdlib_module_names}  # by their names


def fingerprint(*things: Any) -> str | None:
    """Digest of functions and classes, the same in every process; None where the content of something is unknown."""
    found, numbers, said = list(things), {id(thing): number for number, thing in enumerate(things)}, []
    for thing in found:  # which grows: everything is told once, and named by its number
        words, parts = _told(thing)
        said.append(words)
        for name, part in parts:
            if isinstance(part, _PLAIN):
                said.append((name, type(part).__name__, repr(part)))
                continue
            if id(part) not in numbers:
                numbers[id(part)] = len(found)
                found.append(part)
            said.append((name, numbers[id(part)]))
        if words is None:
            return None
    return hashlib.sha256(repr(said).encode()).hexdigest()


def _told(thing: Any) -> tuple[Any, list[tuple[str, Any]]]:
    """Words of a thing, and what it is made of, by name; no words where nothing tells what it is."""
    match thing:
        case types.FunctionType():
            if _is_known(thing.__globals__.get("__name__")):  # maybe round one of ours, as `jax.vmap` makes them
                return f"{thing.__module__}.{thing.__qualname__}", [("", getattr(thing, "__wrapped__", None))]
            cells = zip(thing.__code__.co_freevars, thing.__closure__ or (), strict=True)
            own = [("code", thing.__code__), ("", thing.__defaults__), ("", thing.__kwdefaults__)]
            return "function", [*own, *((name, _content(cell)) for name, cell in cells), *_named(thing)]
        case types.CodeType():
            return thing.co_code, [("", part) for part in (*thing.co_consts, *thing.co_names, *thing.co_varnames)]
        case type():
            return f"{thing.__module__}.{thing.__qualname__}", list(_of_class(thing))
        case tuple() | list():
            return type(thing).__name__, [("", part) for part in thing]
        case set() | frozenset():
            return sorted(map(repr, thing)), []
        case dict():
            return "dict", [(repr(key), value) for key, value in thing.items()]
        case np.ndarray() | jax.Array():
            return (str(thing.dtype), thing.shape, np.asarray(thing).tobytes()), []
        case functools.partial():
            return "partial", [("", thing.func), ("", thing.args), ("", thing.keywords)]
        case types.MethodType():
            return "method", [("", thing.__func__), ("", thing.__self__)]
        case property():
            return "property", [("", thing.fget)]
        case classmethod() | staticmethod():
            return type(thing).__name__, [("", thing.__func__)]
        case types.ModuleType() | ContextVar():
            return type(thing).__name__, [("", thing.name if isinstance(thing, ContextVar) else thing.__name__)]
    return _instance(thing)


def _instance(thing: Any) -> tuple[Any, list[tuple[str, Any]]]:
    """An object of any class: what it wraps, its attributes, or its name."""
    kind = ("", type(thing))
    if hasattr(thing, "__wrapped__"):  # as of `jax.jit` and `functools.cache`
        return "wrapper", [kind, ("", thing.__wrapped__)]
    if hasattr(thing, "__dict__"):
        return "object", [kind, *sorted(vars(thing).items())]
    if isinstance(name := getattr(thing, "__qualname__", getattr(thing, "__name__", None)), str):
        return f"{getattr(thing, '__module__', None)}.{name}", [kind]
    words = repr(thing)
    return None if " at 0x" in words else words, [kind]


def _is_known(module: str | None) -> bool:
    return str(module).split(".")[0] in _KNOWN


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # nothing yet
        return None


def _of_class(kind: type) -> Iterator[tuple[str, Any]]:
    """Bases and members of a class; of one of a known package those that are not from there."""
    is_known = _is_known(kind.__module__)
    for base in kind.__bases__:
        yield "base", base
    for name, member in sorted(vars(kind).items()):
        function = getattr(member, "__func__", getattr(member, "fget", member))
        is_function = isinstance(function, types.FunctionType)
        if is_known:
            if is_function and not _is_known(function.__globals__.get("__name__", "dataclasses")):
                yield name, function
        elif is_function or not name.startswith(("__", "_abc_")):
            yield name, member


def _named(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """What the global names in a function's code stand for; of modules those members that it names, too."""
    names = list(dict.fromkeys(_names(function.__code__)))
    for name in names:
        value = function.__globals__.get(name, sys.modules.get(name))
        if isinstance(value, types.ModuleType):
            yield from _members(value, name, names, set())
        elif name in function.__globals__:
            yield name, value


def _names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _names(part)


def _members(module: types.ModuleType, path: str, names: list[str], seen: set) -> Iterator[tuple[str, Any]]:
    seen.add(module.__name__)
    for name in names:
        value = vars(module).get(name, module)
        if isinstance(value, types.ModuleType):
            if value.__name__ not in seen:
                yield from _members(value, f"{path}.{name}", names, seen)
        else:
            yield f"{path}.{name}", value
