"""Checks of a run's folder: whether each file is whole, and a digest of what must not depend on kills."""

import hashlib
import json
from collections.abc import Callable, Collection
from pathlib import Path

from emgs_jax import load_map
from emgs_jax.data.reading import damage
from emgs_jax.io.npz import read_npz
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.io.trajectory import load_trajectory_tum

TIMES = ("seconds", "compile_seconds")  # of a line of frames.jsonl


def log_lines(folder: Path) -> list[dict]:
    """frames.jsonl without its times."""
    found = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in TIMES} for line in found]


def metrics(folder: Path) -> dict:
    """metrics.json without times and memory."""
    found = json.loads((folder / "metrics.json").read_text())
    return {key: value for key, value in found.items() if not key.startswith(("time/", "memory/"))}


def outputs(folder: Path) -> list[Path]:
    """The files of a run; Hydra's own and those of earlier runs are in folders."""
    return [path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.endswith(".log")]


def digest(folder: Path, names: Collection[str] | None = None) -> dict[str, str]:
    """Digest of each output by name, or of some; of the log and the metrics without times, of what shows those none."""
    read = {
        "frames.jsonl": lambda path: json.dumps(log_lines(folder)).encode(),
        "metrics.json": lambda path: json.dumps(metrics(folder), sort_keys=True).encode(),
        "overview.png": lambda path: b"",
        "report.html": lambda path: b"",
    }
    contents = {
        path.name: read.get(path.name, Path.read_bytes)(path)
        for path in outputs(folder)
        if names is None or path.name in names
    }
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def _lines(path: Path) -> None:
    for line in path.read_text().splitlines():
        json.loads(line)


def _picture(path: Path) -> None:
    reason = damage(path.read_bytes())
    if reason is not None:
        raise ValueError(reason)


def _page(path: Path) -> None:
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError("it has no end")


def _arrays(path: Path) -> None:
    with open(path, "rb") as file:
        read_npz(file)


READERS: dict[str, Callable[[Path], object]] = {
    "metrics.json": lambda path: json.loads(path.read_text()),
    "frames.jsonl": _lines,
    "trajectory.txt": load_trajectory_tum,
    "trajectory_online.txt": load_trajectory_tum,
    "map.npz": load_map,
    "map.ply": read_vertices,
    "points.ply": read_vertices,
    "mesh.ply": read_vertices,
    "overview.png": _picture,
    "report.html": _page,
    "sweep.json": lambda path: json.loads(path.read_text()),
    "loops.json": lambda path: json.loads(path.read_text()),
    "places.npz": _arrays,
    "text.npz": _arrays,
    "checkpoint.npz": _arrays,
}


def faults(folder: Path, may_hold_temporaries: bool) -> list[str]:
    """List what is wrong with the outputs that are there.

    Args:
        folder: of a run that was stopped.
        may_hold_temporaries: SIGKILL leaves no time to remove them; the next run does.
    """
    found = []
    for path in outputs(folder):
        if path.name.startswith(".") and ".tmp" in path.name:
            found += [] if may_hold_temporaries else [f"{path.name} is left over"]
            continue
        try:
            READERS.get(path.name, Path.read_bytes)(path)
        except Exception as error:  # whatever it is, the file is not what it should be
            found.append(f"{path.name} is not whole: {error}")
    return found


def lost(folder: Path, before: dict[str, bytes]) -> list[str]:
    """Outputs of an earlier run, by name, that are neither in a folder nor in the previous-… that a new run makes."""
    places = [folder, *folder.glob("previous-*")]
    kept = {name: [place / name for place in places if (place / name).exists()] for name in before}
    return [name for name, content in before.items() if not any(path.read_bytes() == content for path in kept[name])]
