"""Read .npz files safely: nothing is unpickled, and no array is larger than the file says and holds.

This program's own files have a JSON header beside their arrays.
"""

import io
import json
import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from emgs_jax.io.files import atomic_write

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
MAX_INFLATED = 2**33  # bytes of a compressed array


def read_npz(
    content: bytes | IO[bytes],
    names: Sequence[str] | None = None,
    optional: Sequence[str] = (),
    may_be_compressed: bool = False,
) -> dict[str, np.ndarray]:
    """Read the arrays `names` of an .npz, which must be there (None: all), and those of `optional` that are.

    Raises:
        ValueError: the file is damaged, lacks a name, is compressed though it may not, or an array's header does not
            fit its bytes.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content) if isinstance(content, bytes) else content) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            missing = [name for name in names or () if name not in members]
            if missing or len(members) < len(archive.infolist()):
                raise ValueError(f"it lacks {', '.join(missing)}" if missing else "it has two arrays of one name")
            chosen = members if names is None else [*names, *(name for name in optional if name in members)]
            return {name: _read_array(archive, members[name], may_be_compressed) for name in chosen}
    except ValueError:
        raise
    except Exception as error:  # a broken zip raises a dozen types
        raise ValueError(repr(error)) from error


def save_headed(
    path: str | os.PathLike, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], key: str = "__header__"
) -> None:
    """Write a header and arrays atomically; `key` names the header among the arrays."""
    content = json.dumps(header, default=lambda value: value.item())
    with atomic_write(path) as handle:
        np.savez(handle, **{key: np.array(content)}, **arrays)


def load_headed(
    path: str | os.PathLike, ours: Mapping[str, Any], key: str = "__header__"
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a file of `save_headed`; ValueError, which does not name it, unless its header has the values of `ours`."""
    with open(path, "rb") as handle:
        arrays = read_npz(handle)
    try:
        header = json.loads(str(arrays.pop(key)))
    except (KeyError, RecursionError) as error:
        raise ValueError("it has no header") from error
    for name, value in ours.items():
        found = header.get(name) if isinstance(header, dict) else None
        if found != value:
            raise ValueError(f"its {name} is {found!r}, this code reads {value!r}")
    return header, arrays


def npz_names(content: IO[bytes]) -> list[str]:
    """The names of the arrays in an .npz; ValueError if it is none."""
    try:
        with zipfile.ZipFile(content) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except Exception as error:
        raise ValueError(repr(error)) from error


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, may_be_compressed: bool) -> np.ndarray:
    """Read one array, after its shape is checked against its bytes."""
    is_compressed = member.compress_type != zipfile.ZIP_STORED
    if is_compressed and not may_be_compressed:
        raise ValueError(f"{member.filename} is compressed, which numpy.savez does not do")
    if is_compressed and member.file_size > MAX_INFLATED:
        raise ValueError(f"{member.filename} announces {member.file_size} bytes, more than {MAX_INFLATED}")
    data = archive.read(member)  # to the end, so that the checksum is tested
    handle = io.BytesIO(data)
    read_header = _HEADERS.get(npy.read_magic(handle))
    if read_header is None:
        raise ValueError(f"{member.filename} is of an unknown version of npy")
    shape, _, dtype = read_header(handle)
    num_bytes = math.prod(shape) * dtype.itemsize
    if num_bytes != len(data) - handle.tell() or min(shape, default=0) < 0:
        raise ValueError(
            f"{member.filename} announces {dtype} {shape}, which is {num_bytes} bytes, and holds "
            f"{len(data) - handle.tell()}"
        )
    handle.seek(0)
    return npy.read_array(handle, allow_pickle=False)
