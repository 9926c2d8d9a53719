"""One case: a run in a process, signals at random times, what is in its folder then, and what it comes to."""

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.tiny_run import SMALL_STEREO, TINY

from .folders import digest, faults, lost, outputs

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Program:
    """A command that is stopped: its name and words, and which of its files are compared (all: None)."""

    name: str
    words: tuple[str, ...]
    compared: tuple[str, ...] | None = None


SETTINGS = ("dataset.stop=12", "prior.level=1", "checkpoint.every=2", "slam.submap.map_capacity=256")
STEREO = (  # a prior that makes a structure of all images first
    *SMALL_STEREO,
    *("dataset.size=[160,120]", "dataset.stop=8", "slam.window_size=5", "checkpoint.every=2"),
)
GATE = "slam.em.max_mahalanobis_sq"
PROGRAMS = (
    Program("run", SETTINGS),
    Program("run", (*SETTINGS, "graph=default", "graph.every=1")),
    Program("run", STEREO),
    Program("sweep", (f"axes={{{GATE}:[1.0,4.6,9.0,16.0]}}", "chunk=1"), ("sweep.csv", "report.html")),
    Program(
        "tune",
        (f"space={{{GATE}:{{low:1,high:20}}}}", "trials=4", "startup=2", "chunk=1", "held_out={other:{prior.seed:3}}"),
        ("trials.csv", "tune.md"),
    ),
)
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SECONDS = 900.0  # that a run may take


@dataclass(frozen=True)
class Whole:
    """A run that nobody stopped: its folder, what is in it, and after how many seconds which file was there."""

    folder: Path
    digest: dict[str, str]
    events: list[tuple[str, float]]  # ends with the end


@dataclass(frozen=True)
class Case:
    """Interruptions of a run and their outcome.

    Args:
        number: with the seed it repeats the choices; the moments themselves depend on the machine.
        stops: what the folder had when which signal came, and how the process ended.
        faults: what is wrong; none where the case holds.
    """

    number: int
    stops: tuple[str, ...]
    faults: tuple[str, ...]


def begin(folder: Path, program: Program, log: Path) -> subprocess.Popen:
    """The program in a process of its own."""
    module = f"experiments.{program.name}"
    command = [sys.executable, "-m", module, *TINY, *program.words, f"hydra.run.dir={folder}"]
    with open(log, "a") as said:  # a pipe that nobody reads is full at some time
        return subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=subprocess.STDOUT)


def event(folder: Path) -> str:
    """Describe the progress of a run: its newest output, with the number of lines of the log."""
    files = [(path.stat().st_mtime_ns, path.name) for path in outputs(folder)] if folder.exists() else []
    name = max(files, default=(0, "start"))[1]
    is_log = name == "frames.jsonl"
    return f"{name} {(folder / name).read_bytes().count(bytes([10]))}" if is_log else name


def watch(process: subprocess.Popen, folder: Path, until: str | None = None) -> list[tuple[str, float]]:
    """Record new outputs in a folder with their seconds, until the process ends or `until` is there."""
    start, seen = time.monotonic(), [("start", 0.0)]
    while process.poll() is None and seen[-1][0] != until:
        if time.monotonic() - start > SECONDS:
            process.kill()
            raise TimeoutError(f"no end after {SECONDS} s; {folder} has {seen}")
        try:
            now = event(folder)
        except FileNotFoundError:
            continue  # moved meanwhile
        if now != seen[-1][0]:
            seen.append((now, time.monotonic() - start))
        time.sleep(0.002)
    return [*seen, ("end", time.monotonic() - start)]


def run_whole(folder: Path, program: Program) -> Whole:
    """The run to compare with; its process has ended well, else RuntimeError."""
    log = folder.with_suffix(".txt")
    process = begin(folder, program, log)
    events = watch(process, folder)
    if process.wait() != 0:
        raise RuntimeError(f"the run that nobody stops ended with {process.returncode}: {log.read_text()[-2000:]}")
    return Whole(folder, digest(folder, program.compared), events)


def run_case(number: int, seed: int, whole: Whole, program: Program, folder: Path) -> Case:
    """Stop a run once, twice or three times, look at its folder each time, and let it go on to its end."""
    rng, log, stops, found = np.random.default_rng((seed, number)), folder.with_suffix(".txt"), [], []
    earlier = {}
    if rng.integers(3) == 0:  # the folder holds the outputs of an earlier run, of which nothing may be lost
        shutil.copytree(whole.folder, folder)
        kept = [path for path in outputs(folder) if program.compared is None or path.name in program.compared]
        earlier = {path.name: path.read_bytes() for path in kept}  # a search goes on in its own journal
    for _ in range(1 + (rng.integers(3) == 0) + (rng.integers(9) == 0)):
        name, wait, sign = _moment(whole, rng)
        process = begin(folder, program, log)
        watch(process, folder, name)
        time.sleep(wait)
        before = event(folder)
        process.send_signal(sign)
        code = process.wait(SECONDS)
        stops.append(f"{sign.name} {wait:.2f} s after {name}, at {before}: ended with {code}")
        if code not in (0, -sign, 128 + sign):
            found.append(f"{sign.name} ended with {code}")
        found += faults(folder, sign == signal.SIGKILL) if folder.exists() else []
        found += [f"{name} of the earlier run is lost" for name in lost(folder, earlier)]
    process = begin(folder, program, log)
    if process.wait(SECONDS) != 0:
        return Case(number, tuple(stops), (*found, f"the same command ended with {process.returncode}"))
    after = digest(folder, program.compared)
    names = sorted({*after, *whole.digest})
    found += [f"{name} is different" for name in names if after.get(name) != whole.digest.get(name)]
    found += [f"{name} of the earlier run is lost" for name in lost(folder, earlier)]
    text = log.read_text()
    if "Traceback" in text:
        found.append(f"traceback: …{text[text.index('Traceback') :][:2000]}")
    return Case(number, tuple(stops), tuple(found))


def _moment(whole: Whole, rng: np.random.Generator) -> tuple[str, float, signal.Signals]:
    """After which event, how many seconds later and with which signal a run is stopped."""
    place = rng.integers(len(whole.events) - 1)
    (name, start), (_, stop) = whole.events[place], whole.events[place + 1]
    return name, float(rng.uniform(0, stop - start)), SIGNALS[rng.integers(len(SIGNALS))]
