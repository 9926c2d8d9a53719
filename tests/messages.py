"""What a reader or a command says of each cause: the key or file, and what to do about it."""

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

Step = Mapping[str, Any] | tuple | Callable[[Path], Any]


def done(step: Step, root: Path) -> dict[str, Any]:
    """Options of the reader after a step: those it is, those of its parts, or none of a function that changes files.

    A text may name `{root}`.
    """
    if isinstance(step, tuple):
        return {key: value for part in step for key, value in done(part, root).items()}
    if callable(step):
        step(root)
        return {}
    filled = {key: value.format(root=root) for key, value in step.items() if isinstance(value, str)}
    return {**step, **{key: yaml.safe_load(value) for key, value in filled.items()}}


def edit(file: str, *pairs: tuple[str, str]) -> Step:
    """Replace parts of a text, each of which must be there."""

    def run(root):
        text = (root / file).read_text()
        for old, new in pairs:
            assert old in text, f"{old} is not in {file}"
            text = text.replace(old, new, 1)
        (root / file).write_text(text)

    return run


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Step:
    """Change the words of each line that is no comment; without any it is gone."""

    def run(root):
        text = (root / file).read_text()
        found = [line if line.startswith("#") else " ".join(change(line.split())) for line in text.splitlines() if line]
        (root / file).write_text("\n".join(filter(None, found)) + "\n")

    return run


def put(file: str, content: str | bytes | np.ndarray) -> Step:
    def run(root):
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        data = cv2.imencode(Path(file).suffix, content)[1].tobytes() if isinstance(content, np.ndarray) else content
        (root / file).write_bytes(data if isinstance(data, bytes) else data.encode())

    return run


def gone(file: str) -> Step:
    return lambda root: (root / file).unlink()


def moved(file: str, to: str) -> Step:
    def run(root):
        (root / to).parent.mkdir(parents=True, exist_ok=True)
        (root / file).rename(root / to)

    return run


def resized(file: str, size: tuple[int, int]) -> Step:
    def run(root):
        image = cv2.imread(str(root / file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(root / file), cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))

    return run


def check_messages(folder: Path, write: Callable, read: Callable, rows: Sequence[tuple[Step, str]]) -> None:
    """What is sound is read; of each cause the message says what is wrong and what to do. All that do not, at once."""
    (folder / "sound").mkdir()
    write(folder / "sound")
    wrong = {}
    for number, (cause, message) in enumerate(rows):
        root = folder / str(number)
        shutil.copytree(folder / "sound", root)
        try:
            read(root, **done(cause, root))
            wrong[message] = "nothing was said"
        except (ValueError, OSError) as error:
            if not re.search(message, str(error)):
                wrong[message] = str(error)
    assert not wrong
