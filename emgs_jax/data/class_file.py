"""Read class names, and the ids of a data set that they stand for.

A file has a name a line; or `id name` or `id,name` a line; or is the YAML of OVO's evaluation (`class_names_reduced`,
`map_to_reduced` and `class_names`). In text `#` begins a comment.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

REMEDY = "give a name a line, `id name` a line, or YAML with class_names_reduced and map_to_reduced"


@dataclass(frozen=True)
class ClassFile:
    """Classes of a file."""

    path: str
    names: tuple[str, ...]  # distinct
    positions: Mapping[int, int] | None  # id -> position in `names`, -1 = no class; None if the file has no ids

    def positions_of(self, ids: np.ndarray, what: object) -> np.ndarray:
        """Position in `names` of each id (n,), -1 = no class; ValueError, which names `what`, if an id is unknown."""
        if self.positions is None:
            raise ValueError(f"{self.path} has names without ids, which {what} needs: {REMEDY}")
        found, inverse = np.unique(ids, return_inverse=True)
        unnamed = [int(number) for number in found if int(number) not in self.positions]
        cut = {number: [n for n in (number - 256, number + 256) if n in self.positions] for number in unnamed}
        nameless = f"{what}: no name in {self.path} for {_some(unnamed)}"
        if unnamed and all(cut.values()):
            raise ValueError(
                f"{nameless}, but for {_some([n[0] for n in cut.values()])}: ids of 16 bits were read or written as 8 "
                "bits; export them again with 16 bits or as text"
            )
        if unnamed:
            raise ValueError(f"{nameless}: give the class file of this data set")
        return np.array([self.positions[int(number)] for number in found], np.int64)[inverse.reshape(np.shape(ids))]


def _some(numbers: list[int]) -> str:
    shown = ", ".join(map(str, numbers[:5]))
    return f"{'id' if len(numbers) == 1 else 'ids'} {shown}{', …' if len(numbers) > 5 else ''}"


def read_classes(path: str | os.PathLike) -> ClassFile:
    """Read a class file; ValueError if it cannot be read or is none."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        raise ValueError(f"class file {path} {reason}: {REMEDY}") from error
    try:
        names, positions = _of_yaml(text) if path.suffix.lower() in (".yaml", ".yml") else _of_lines(text)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path} is no class file ({' '.join(str(error).split())}): {REMEDY}") from error
    twice = sorted({name for name in names if names.count(name) > 1})
    if not names or twice:
        raise ValueError(f"{path} names {', '.join(map(repr, twice)) + ' twice' if twice else 'no class'}: {REMEDY}")
    return ClassFile(str(path), tuple(names), positions)


def _of_yaml(text: str) -> tuple[list[str], dict[int, int]]:
    content = yaml.safe_load(text)
    missing = [key for key in ("class_names_reduced", "map_to_reduced") if key not in _checked(Mapping, content, "it")]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    names = [_word(name) for name in _checked(list, content["class_names_reduced"], "class_names_reduced")]
    # OVO leaves out points of classes that the scenes do not have; an id without a name is an error.
    positions = {number: -1 for number, _ in enumerate(_checked(list, content.get("class_names") or [], "class_names"))}
    for number, position in _checked(Mapping, content["map_to_reduced"], "map_to_reduced").items():
        if not isinstance(number, int) or not isinstance(position, int) or not 0 <= position <= len(names):
            raise ValueError(f"map_to_reduced says {number!r}: {position!r}, and there are {len(names)} classes")
        positions[number] = position if position < len(names) else -1
    return names, positions


def _of_lines(text: str) -> tuple[list[str], dict[int, int] | None]:
    lines = [line for line in (raw.split("#")[0].strip() for raw in text.splitlines()) if line]
    rows = [re.fullmatch(r"(-?[0-9]{1,9})(?:\s*[,;]\s*|\s+)(.+)", line) for line in lines]
    if 2 * sum(row is not None for row in rows) <= len(rows):  # a name may begin with a number
        return [_word(line) for line in lines], None
    odd = [line for line, row in zip(lines, rows, strict=True) if row is None]
    if odd:
        raise ValueError(f"most lines are `id name` and {odd[0][:60]!r} is not: give each an id, or none")
    positions = {int(row[1]): number for number, row in enumerate(rows) if row}
    if len(positions) < len(rows):
        raise ValueError("an id stands in it twice")
    return [_word(row[2]) for row in rows if row], {0: -1} | positions


def _checked(kind: type, value: Any, what: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{what} is no {kind.__name__.lower()}")
    return value


def _word(value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise ValueError(f"{value!r} is no name")
    return value.strip()
