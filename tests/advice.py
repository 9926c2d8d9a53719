"""Advice helps: a table has causes, messages, and what the messages say, which is done, after which the same works.

A row is a cause, the message, and remedies, each of which is tried by itself on files that are sound but for the cause.
Without any it is to have the files as they were.
"""

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

LEFT_OUT = object()  # the value of an option that is not given

Said = re.Match | None
Step = Mapping[str, Any] | tuple | Callable[[Path, Said], Any]


def done(step: Step, root: Path, said: Said = None) -> dict[str, Any]:
    """Options of the reader after a step: those it is, those of its parts, or none of a function that changes files.

    A text may name `{root}`, and by its number a part of what the message said.
    """
    if isinstance(step, tuple):
        return {key: value for part in step for key, value in done(part, root, said).items()}
    if callable(step):
        step(root, said)
        return {}
    words = () if said is None else (said[0], *said.groups())
    filled = {key: value.format(*words, root=root) for key, value in step.items() if isinstance(value, str)}
    return {**step, **{key: yaml.safe_load(value) for key, value in filled.items()}}


def edit(file: str, *pairs: tuple[str, str]) -> Step:
    """Replace parts of a text, each of which must be there."""

    def run(root, said):
        text = (root / file).read_text()
        for old, new in pairs:
            assert old in text, f"{old} is not in {file}"
            text = text.replace(old, new, 1)
        (root / file).write_text(text)

    return run


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Step:
    """Change the words of each line that is no comment; without any it is gone."""

    def run(root, said):
        text = (root / file).read_text()
        found = [line if line.startswith("#") else " ".join(change(line.split())) for line in text.splitlines() if line]
        (root / file).write_text("\n".join(filter(None, found)) + "\n")

    return run


def put(file: str, content: str | bytes | np.ndarray) -> Step:
    def run(root, said):
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        data = cv2.imencode(Path(file).suffix, content)[1].tobytes() if isinstance(content, np.ndarray) else content
        (root / file).write_bytes(data if isinstance(data, bytes) else data.encode())

    return run


def gone(file: str) -> Step:
    return lambda root, said: (root / file).unlink()


def moved(file: str, to: str) -> Step:
    def run(root, said):
        (root / to).parent.mkdir(parents=True, exist_ok=True)
        (root / file).rename(root / to)

    return run


def fetched(file: str) -> Step:
    """The file as it was."""
    return lambda root, said: shutil.copy(root.parent / "sound" / file, root / file)


def all_fetched(root: Path, said: Said) -> None:
    shutil.rmtree(root)
    shutil.copytree(root.parent / "sound", root)


def resized(file: str, size: tuple[int, int]) -> Step:
    def run(root, said):
        image = cv2.imread(str(root / file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(root / file), cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))

    return run


Tables = Mapping[str, tuple[Callable[[Path], Any], Callable[..., Any], Sequence[tuple]]]  # what is written, read, rows


def sound_files(tables: Tables) -> Callable:
    """A fixture: the folder of what a table's files are, written once."""

    @pytest.fixture(scope="module")
    def sound(tmp_path_factory):
        @cache
        def written(name: str) -> Path:
            folder = tmp_path_factory.mktemp(name)
            tables[name][0](folder)
            return folder

        return written

    return sound


def each_remedy(tables: Tables) -> Callable:
    """A mark: every cause and message of the tables with every remedy."""
    cases = [
        (name, *row[:2], remedy)
        for name, (_, _, rows) in tables.items()
        for row in rows
        for remedy in row[2:] or [all_fetched]
    ]
    names = [f"{name}: {message[:40]}" for name, _, message, _ in cases]
    return pytest.mark.parametrize(("name", "cause", "message", "remedy"), cases, ids=names)


def check_helps(read: Callable, sound: Path, cause: Step, message: str, remedy: Step, folder: Path) -> None:
    """Follow the advice of a message in a copy of the files; reading them has to give something then."""
    root = folder / "copy"
    shutil.copytree(sound, root)
    (folder / "sound").symlink_to(sound)
    options = done(cause, root)
    with pytest.raises((ValueError, OSError)) as caught:
        read(root, **options)
    said = re.search(message, str(caught.value))
    assert said is not None, caught.value
    options |= done(remedy, root, said)
    assert read(root, **{key: value for key, value in options.items() if value is not LEFT_OUT})
