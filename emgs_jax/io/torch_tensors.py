"""Read the tensors of a file of `torch.save` without torch, and without running code of the file.

The file is an archive: a pickle of what was saved, and a member for every storage. Before version 1.6 it was five
pickles (magic number, version, machine, what was saved, names of storages) and then every storage: its number of
elements and its bytes. Only instructions that make dictionaries, lists, numbers and tensors are followed.
"""

import math
import pickletools
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np

MAGIC = 0x1950A86A20F9469CFC6C
DTYPES = {"torch FloatStorage": "<f4", "torch LongStorage": "<i8"}
DAMAGED = (LookupError, TypeError, AttributeError, UnicodeDecodeError, RuntimeError, OverflowError)
DAMAGED += (BadZipFile, EOFError, zlib.error)
_MARK = object()
_LITERALS = {"MARK": lambda: _MARK, "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False}
_LITERALS |= {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}


class _Tensor(NamedTuple):
    storage: tuple  # ("storage", class, name, device, number of elements, …)
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # elements


def read_tensors(content: bytes, key: str | None) -> dict[str, np.ndarray]:
    """Read tensors by name, under `key` of what was saved (None: at the top); ValueError if the file is damaged."""
    try:
        saved, storages = (_from_archive if content.startswith(b"PK") else _from_stream)(BytesIO(content))
        tensors: Mapping[str, _Tensor] = saved if key is None else saved[key]
        return {name: _array(storages[tensor.storage[2]], tensor) for name, tensor in tensors.items()}
    except DAMAGED as error:
        raise ValueError(f"damaged ({type(error).__name__}: {error})") from error


def _from_archive(stream: BytesIO) -> tuple[Any, dict[str, np.ndarray]]:
    """What was saved, and the storages by name."""
    with ZipFile(stream) as archive:
        first = [name for name in archive.namelist() if name.endswith("/data.pkl")][0]
        saved = _value(BytesIO(archive.read(first)))
        folder = first.removesuffix(".pkl")
        known = {tensor.storage[2]: tensor.storage for tensor in _tensors(saved)}
        return saved, {name: _numbers(archive.read(f"{folder}/{name}"), known[name]) for name in known}


def _from_stream(stream: BytesIO) -> tuple[Any, dict[str, np.ndarray]]:
    """What was saved, and the storages by name, before version 1.6."""
    if _value(stream) != MAGIC:
        raise ValueError("not of torch.save")
    _, _, saved, names = (_value(stream) for _ in range(4))
    known = {tensor.storage[2]: tensor.storage for tensor in _tensors(saved)}
    storages = {}
    for name in names:
        count = known[name][4]
        if int.from_bytes(stream.read(8), "little") != count:
            raise ValueError("a storage has another number of elements than its tensor says")
        storages[name] = _numbers(stream.read(count * np.dtype(DTYPES[known[name][1]]).itemsize), known[name])
    return saved, storages


def _numbers(content: bytes, described: tuple) -> np.ndarray:
    return np.frombuffer(content, np.dtype(DTYPES[described[1]]), described[4])


def _array(storage: np.ndarray, tensor: _Tensor) -> np.ndarray:
    """A tensor from its storage, where it must lie row by row."""
    steps = [math.prod(tensor.shape[axis + 1 :]) for axis in range(len(tensor.shape))]
    if any(step != known and size > 1 for step, known, size in zip(steps, tensor.strides, tensor.shape, strict=True)):
        raise ValueError("a tensor is no plain array")
    return storage[tensor.offset :][: math.prod(tensor.shape)].reshape(tensor.shape)


def _tensors(value: Any) -> list[_Tensor]:
    """All tensors in dictionaries and lists."""
    if isinstance(value, _Tensor):
        return [value]
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [tensor for item in inner for tensor in _tensors(item)]


def _value(stream: BytesIO) -> Any:
    """Follow the next pickle of a stream, as far as it makes plain data and tensors."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}

    def since_mark() -> list:
        start = len(stack) - 1 - stack[::-1].index(_MARK)
        items = stack[start + 1 :]
        del stack[start:]
        return items

    for code, argument, _ in pickletools.genops(stream):
        match code.name:
            case "PROTO" | "STOP" | "BINPERSID":  # the last makes a storage of the tuple that describes it
                pass
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "BINUNICODE" | "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "GLOBAL":
                stack.append(argument)
            case name if name in _LITERALS:
                stack.append(_LITERALS[name]())
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(code.name[-1])
                stack[-count:] = [tuple(stack[-count:])]
            case "SETITEMS" | "SETITEM":
                items = since_mark() if code.name == "SETITEMS" else [stack.pop(-2), stack.pop()]
                stack[-1].update(zip(items[::2], items[1::2], strict=True))
            case "APPENDS" | "APPEND":
                items = since_mark() if code.name == "APPENDS" else [stack.pop()]
                stack[-1].extend(items)
            case "BUILD":
                stack.pop()  # versions of layers, beside the dictionary of their tensors
            case "REDUCE":
                arguments, name = stack.pop(), stack.pop()
                stack.append(_made(name, arguments))
            case _:
                raise ValueError(f"has more than tensors ({code.name})")
    return stack[-1]


def _made(name: str, arguments: tuple) -> Any:
    """What a function that the file names would make."""
    if name == "collections OrderedDict" and not arguments:
        return {}
    if name == "torch._utils _rebuild_tensor_v2":
        return _Tensor(*arguments[:4])
    raise ValueError(f"has more than tensors ({name})")
