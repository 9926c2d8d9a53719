"""Read PLY strictly: the file must hold what its header says."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.geometry import Sim3, rotated
from emgs_jax.io.files import write_file

REMEDY = "write the file again"
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
_TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 20


class Element(NamedTuple):
    """An element of a PLY header; `properties` maps names to types, None for a list."""

    name: str
    count: int
    properties: dict[str, str | None]


def read_vertices(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read the properties of a PLY's vertices, each (n,) in the header's type.

    Raises:
        ValueError: the file is no PLY, is shorter or longer than its header says, or has no x, y and z.
    """
    content = Path(path).read_bytes()
    order, elements, start = _header(content, path)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= vertex.properties.keys():
        raise ValueError(f"{path} has no element vertex with the properties x, y and z: it holds no points; {REMEDY}")
    body, before = memoryview(content)[start:], elements[: elements.index(vertex)]
    if None in [kind for element in (*before, vertex) for kind in element.properties.values()]:
        raise ValueError(f"{path} has a list among or before its vertices, which is not read: {REMEDY} without it")
    if order == "":
        return _read_text(bytes(body), elements, vertex, path)
    _check_size(len(body), elements, path)
    skipped = sum(element.count * _row_type(element, order).itemsize for element in before)
    rows = np.frombuffer(body, _row_type(vertex, order), vertex.count, skipped)
    return {name: rows[name].astype(rows.dtype[name].newbyteorder("=")) for name in vertex.properties}


def num_faces(path: str | os.PathLike) -> int:
    with Path(path).open("rb") as file:
        _, elements, _ = _header(file.read(_MAX_HEADER_BYTES + len("\r\n")), path)
    return sum(element.count for element in elements if element.name == "face")


def transform_ply(path: str | os.PathLike, target: str | os.PathLike, to_target: Sim3, comment: str = "") -> None:
    """Copy a binary PLY that begins with its vertices into another world: points, normals, Gaussians' scales and turns.

    `comment` is added to the header.

    Raises:
        ValueError: as `read_vertices`, or the file is ascii or has something before the vertices.
    """
    read_vertices(path)
    content = Path(path).read_bytes()
    order, elements, start = _header(content, path)
    if order == "" or elements[0].name != "vertex":
        raise ValueError(f"{path} is not as this program writes it (binary, vertices first): {REMEDY}")
    row_type = _row_type(elements[0], order)
    end = start + elements[0].count * row_type.itemsize
    rows = np.frombuffer(content[start:end], row_type).copy()
    names = elements[0].properties.keys()
    _set(rows, "x y z", to_target.apply(_get(rows, "x y z")))
    for name in {"scale_0", "scale_1", "scale_2"} & names:
        rows[name] += math.log(to_target.scale)
    if not np.array_equal(to_target.rotation, np.eye(3)):
        if {"nx", "ny", "nz"} <= names:
            _set(rows, "nx ny nz", rotated(_get(rows, "nx ny nz"), to_target.rotation))
        if "rot_0" in names:
            turn = Rotation.from_quat(_get(rows, "rot_0 rot_1 rot_2 rot_3"), scalar_first=True)
            turned = (Rotation.from_matrix(to_target.rotation) * turn).as_quat(canonical=True, scalar_first=True)
            _set(rows, "rot_0 rot_1 rot_2 rot_3", turned)
    head = content[:start]
    if comment:
        before, found, after = head.rpartition(b"end_header")
        head = before + f"comment {comment}\n".encode() + found + after
    write_file(target, head + rows.tobytes() + content[end:])


def _get(rows: np.ndarray, names: str) -> np.ndarray:
    """The columns (n, k) of a structured array, float64."""
    return np.stack([rows[name].astype(np.float64) for name in names.split()], axis=1)


def _set(rows: np.ndarray, names: str, values: np.ndarray) -> None:
    for name, column in zip(names.split(), values.T, strict=True):
        rows[name] = column


def _header(content: bytes, path: object) -> tuple[str, list[Element], int]:
    """Byte order ("" for text), elements and offset of the body."""
    if not content.startswith((b"ply\n", b"ply\r")):
        raise ValueError(f"{path} is no PLY file (it does not begin with the word ply): give a PLY file")
    end = content.find(b"end_header", 0, _MAX_HEADER_BYTES)
    start = content.find(b"\n", end) + 1
    if end < 0 or start == 0:
        raise ValueError(f"{path} has no end_header: it is truncated, {REMEDY}")
    order, elements, names = None, [], []
    for number, line in enumerate(content[:end].decode("ascii", "replace").splitlines()[1:], start=2):
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                continue
            case ["format", name, "1.0"] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 19 and name not in names:
                elements.append(Element(name, int(count), {}))
                names.append(name)
            case ["property", *kinds, name] if elements and name not in elements[-1].properties and _is_type(kinds):
                elements[-1].properties[name] = None if kinds[0] == "list" else _TYPES[kinds[0]]
            case _:
                raise ValueError(f"{path}, line {number}: {line[:80]!r} is no line of a PLY header: {REMEDY}")
    if order is None:
        raise ValueError(f"{path} does not say its format (ascii, binary_little_endian or _big_endian): {REMEDY}")
    return order, elements, start


def _is_type(words: list[str]) -> bool:
    """Test whether words are a type, or `list` with the types of its length and its elements."""
    is_list = len(words) == 3 and words[0] == "list"
    return {*words[1:]} <= _TYPES.keys() if is_list else len(words) == 1 and words[0] in _TYPES


def _row_type(element: Element, order: str) -> np.dtype:
    return np.dtype([(name, order + str(kind)) for name, kind in element.properties.items()])


def _check_size(num_bytes: int, elements: list[Element], path: object) -> None:
    """Raise ValueError if a binary body has not the length that its header says; a list takes one byte or more."""
    is_open = any(None in element.properties.values() for element in elements)
    sizes = [sum(np.dtype(kind or "u1").itemsize for kind in element.properties.values()) for element in elements]
    expected = sum(size * element.count for size, element in zip(sizes, elements, strict=True))
    if num_bytes < expected or (num_bytes > expected and not is_open):
        counts = ", ".join(f"{element.count} × {element.name}" for element in elements)
        raise ValueError(
            f"{path} has {num_bytes} bytes after its header, which announces {expected} ({counts}): it is "
            f"{'truncated' if num_bytes < expected else 'another file’s header'}, {REMEDY}"
        )


def _read_text(body: bytes, elements: list[Element], vertex: Element, path: object) -> dict[str, np.ndarray]:
    """Read the vertices of an ascii file, which has a line for each row of each element."""
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    expected = sum(element.count for element in elements)
    if len(lines) != expected:
        raise ValueError(f"{path} has {len(lines)} rows after its header, which announces {expected}: {REMEDY}")
    first = sum(element.count for element in elements[: elements.index(vertex)])
    table = np.empty((vertex.count, len(vertex.properties)))
    for row, line in enumerate(lines[first : first + vertex.count]):
        try:
            table[row] = [float(word) for word, _ in zip(line.split(), vertex.properties, strict=True)]
        except ValueError as error:
            what = f"expected {len(vertex.properties)} numbers, got {line[:80]!r}"
            raise ValueError(f"{path}, vertex {row} (from 0): {what}: {REMEDY}") from error
    read = {}
    for name, column in zip(vertex.properties, table.T, strict=True):
        with np.errstate(invalid="ignore"):  # nan as an integer
            read[name] = column.astype(vertex.properties[name])
        if read[name].dtype.kind in "iu" and not (fits := read[name] == column).all():
            row = int(np.argmin(fits))
            what = f"{name} is {column[row]:g} and not {read[name].dtype}, as the header says"
            raise ValueError(f"{path}, vertex {row} (from 0): {what}: {REMEDY}")
    return read
