"""Atomic writes: whatever interrupts one, the file holds its old content or all of the new."""

import contextlib
import dataclasses
import json
import math
import os
import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, mode: str = "wb", outlives_power: bool = True) -> Iterator[IO]:
    """Open a temporary file, which becomes `path` if the block succeeds; an OSError inside names `path`.

    Args:
        path: of the file.
        mode: as of `open`.
        outlives_power: wait until the content is on the disk, as a power cut would otherwise leave an empty file. A
            program that is killed leaves whole files without that.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        with open(temporary, mode, encoding=None if "b" in mode else "utf-8") as handle:
            yield handle
            handle.flush()
            if outlives_power:
                os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _named(error, path) from error
    finally:
        with contextlib.suppress(OSError):  # it was moved, or cannot be removed
            temporary.unlink()


def write_file(path: str | os.PathLike, content: str | bytes) -> None:
    with atomic_write(path, "w" if isinstance(content, str) else "wb") as handle:
        handle.write(content)


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder that becomes `path` if the block succeeds, else is removed.

    Raises:
        ValueError: `path` exists, or another program is making it.
    """
    if path.exists():
        raise ValueError(f"{path} is there already: remove it, or write elsewhere")
    partial = path.with_name(f".{path.name}.partial")
    try:
        with owned(partial):
            try:
                for left in partial.iterdir():  # by a program that was killed
                    shutil.rmtree(left) if left.is_dir() else left.unlink()
                yield partial
                os.rename(partial, path)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise _named(error, path) from error


@contextlib.contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Make a folder and lock it for this process; ValueError if another program holds the lock.

    The system releases the lock when the process ends. Where it has no locks, nothing is refused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # not on this system
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise ValueError(f"another program is writing into {folder}: wait, or name another folder") from error
    except OSError:  # a file system without locks
        pass
    try:
        yield
    finally:
        os.close(descriptor)


def check_writable(path: Path, what: str) -> None:
    """Raise ValueError if a folder can neither be written to nor be made; `what` names it. Makes nothing."""
    nearest = next((place for place in (path, *path.parents) if place.exists()), Path())
    if not (nearest.is_dir() and os.access(nearest, os.W_OK)):
        raise ValueError(f"{what}: {nearest} is no folder that can be written to: choose another one")


def remove_temporaries(folder: Path) -> list[str]:
    """Remove what killed processes left in `folder` of an `atomic_write` or of a camera; return the names."""
    found = [(path, re.fullmatch(r"\..+\.(\d+)\.tmp(\..*)?", path.name)) for path in sorted(folder.glob(".*.tmp*"))]
    dead = [path for path, name in found if name and not _is_running(int(name[1]))]
    for path in dead:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return [path.name for path in dead]


def _is_running(process: int) -> bool:
    """Test whether a process with this number is running; True where the system cannot be asked."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)  # asks only
    except (OSError, OverflowError) as error:
        return isinstance(error, PermissionError)  # another user's
    return True


def jsonable(value: Any) -> Any:
    """Turn arrays, NumPy scalars, paths, dataclasses and mappings into JSON values; NaN and infinity become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: jsonable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(item) for item in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "__array__"):
        return jsonable(np.asarray(value).tolist())
    return str(value)


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings to values by dotted key."""
    values = {}
    for key, value in tree.items():
        values |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return values


def changes(before: Mapping[str, Any], now: Mapping[str, Any], but: Collection[str] = ()) -> list[str]:
    """Describe each value in which two JSON trees differ, except at the dotted keys `but`."""
    before, now = flat(before), flat(now)
    changed = (key for key in sorted({*before, *now} - {*but}) if before.get(key) != now.get(key))
    return [f"{key} was {before.get(key)!r}, now it is {now.get(key)!r}" for key in changed]


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as indented, strict JSON."""
    write_file(path, json.dumps(jsonable(value), indent=2, allow_nan=False) + "\n")


class FrameLog(contextlib.AbstractContextManager):
    """A new JSON-lines file. Every line is complete: one that does not fit on the disk is cut off again."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self._file = open(self.path, "wb", buffering=0)  # noqa: SIM115 (closed by the with statement)

    def append(self, record: Mapping[str, Any]) -> None:
        line = (json.dumps(jsonable(record), allow_nan=False) + "\n").encode()
        start = self._file.tell()
        try:
            while line:
                line = line[self._file.write(line) :]
        except OSError as error:
            self._file.truncate(start)
            self._file.seek(start)
            raise _named(error, self.path) from error

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _named(error: OSError, path: Path) -> OSError:
    words = f"cannot write ({error.strerror or error})"
    return OSError(f"{words}: {path}") if error.errno is None else OSError(error.errno, words, str(path))
