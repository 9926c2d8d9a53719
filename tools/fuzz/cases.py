"""One case: a sound input, a damage, and the verdict of what reading it did."""

import json
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .targets import Target

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 20.0  # that one input may take to read
SAME, ERROR, FAULT = "read", "clear error", "fault"


@dataclass(frozen=True)
class Case:
    """Damage to an input and its outcome.

    Args:
        number: with the seed it repeats the case.
        target: kind of the input.
        damage: names of the damages and the file that they were done to.
        verdict: `read` (and every promise about what is read holds), `clear error` (of a kind that the commands show
            as one line, and that names the file or key) or `fault`.
        message: of the error.
    """

    number: int
    target: str
    damage: str
    verdict: str
    message: str = ""


def run_case(number: int, seed: int, targets: Sequence[Target], sound: Path) -> Case:
    """Damage a copy of a sound input and read it; `sound` keeps one of each kind."""
    rng = np.random.default_rng((seed, number))
    target = targets[number % len(targets)]
    original = sound / target.name
    if not original.exists():
        original.mkdir(parents=True)
        target.write(original)
        target.read(original)  # a sound input that is refused would make every verdict a clear error
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "input"
        shutil.copytree(original, folder)
        path, names = _damage(folder, target, rng)
        what = f"{'+'.join(names)} of {path.relative_to(folder)}"
        verdict, message = _verdict(target, folder, path)
    return Case(number, target.name, what, verdict, message)


def _damage(folder: Path, target: Target, rng: np.random.Generator) -> tuple[Path, list[str]]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and _end(path, target)]
    path = files[rng.integers(len(files))]
    damages = target.damages[_end(path, target)]
    if rng.integers(40) == 0:
        path.unlink()
        return path, ["removed"]
    names = []
    for _ in range(1 + (rng.integers(4) == 0)):
        damage = damages[rng.integers(len(damages))]
        path.write_bytes(damage(path.read_bytes(), rng))
        names.append(damage.__name__)
    return path, names


def _end(path: Path, target: Target) -> str:
    return next((end for end in target.damages if path.name.endswith(end)), "")


def _verdict(target: Target, folder: Path, path: Path) -> tuple[str, str]:
    start = time.monotonic()
    words = path.read_text(errors="replace").replace("=", "\n").split("\n") if path.exists() else []
    try:
        target.read(folder)
    except (ValueError, OSError) as error:
        message = str(error)
        inside = {other.name for other in folder.rglob("*")}  # a list may be wrong and name what it lists
        named = any(name in message for name in (path.name, path.parent.name, str(folder), *inside))
        named |= target.name == "command line" and any(word and word in message for word in words)
        verdict = (ERROR if named else FAULT), message if named else f"names no file: {message}"
    except Exception:
        verdict = FAULT, traceback.format_exc(limit=-4)
    else:
        verdict = SAME, ""
    spent = time.monotonic() - start
    return verdict if spent <= SECONDS else (FAULT, f"took {spent:.0f} s: {verdict[1]}")


def run_cases(first: int, count: int, seed: int) -> Iterator[Case]:
    """Cases first … first + count - 1 in processes of their own: what ends one is a fault, and the next goes on."""
    position, end = first, first + count
    while position < end:
        command = [sys.executable, "-m", "tools.fuzz", "--inside", "--seed", str(seed)]
        command += ["--first", str(position), "--cases", str(end - position)]
        with tempfile.TemporaryFile("w+", errors="replace") as said:  # a pipe is full some day, and the child waits
            child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=said, text=True)
            for line in child.stdout:
                if line.startswith("{"):
                    yield Case(**json.loads(line))
                    position += 1
            code = child.wait()
            if position < end:
                said.seek(0)
                yield Case(position, "?", "?", FAULT, f"the process ended with {code}: {said.read()[-2000:]}")
                position += 1


def print_case(case: Case) -> None:
    """A line as `run_cases` reads it."""
    print(json.dumps(asdict(case)), flush=True)
