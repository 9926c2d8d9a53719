"""Which plausible bugs do a file's own tests notice? Not collected by pytest: `python tests/mutants.py --only icp`.

Each mutant of `*_mutants.py` is one change of one file. It is made in a copy of the repository, where the file's own
tests have to fail. First those tests have to pass without a change.
"""

import argparse
import contextlib
import importlib
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mutant import Mutant

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
# Imported once, before each run is forked off; none of them may start JAX's backend.
HEAVY = [
    "pytest",
    "jax",
    "jax.numpy",
    "equinox",
    "jaxlie",
    "optimistix",
    "lineax",
    "beartype",
    "hydra",
    "scipy.spatial",
]
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", re.MULTILINE)


def collect(only: str = "") -> list[Mutant]:
    """All mutants whose file or bug contains `only`."""
    modules = (importlib.import_module(path.stem) for path in sorted(TESTS.glob("*_mutants.py")))
    return [mutant for module in modules for mutant in module.MUTANTS if only in f"{mutant.file}: {mutant.bug}"]


def copy_tree(folder: Path) -> Path:
    """The repository's files, without what git ignores."""
    listed = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True)
    for name in listed.splitlines():
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    return folder


def change(mutant: Mutant, root: Path) -> None:
    """Make the mutant's change.

    Raises:
        ValueError: its text is not found exactly once.
    """
    path = root / mutant.file
    text = path.read_text()
    if text.count(mutant.before) != 1:
        raise ValueError(f"{mutant.file}: found {text.count(mutant.before)} times, not once: {mutant.before!r}")
    path.write_text(text.replace(mutant.before, mutant.after))


def run_tests(root: str, tests: tuple[str, ...], log: str) -> None:
    """Run tests in a tree, output to a file (in a process of its own)."""
    os.chdir(root)
    sys.path[:] = [root, *(entry for entry in sys.path if Path(entry or ".").resolve() not in (ROOT, TESTS))]
    os.environ["PYTHONPATH"] = root
    with open(log, "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        import pytest

        code = pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=line", "-rfE", *tests])
    os._exit(int(code))  # what the tests registered to run at the end is of no use here


def first_failure(tests: tuple[str, ...], mutant: Mutant | None, timeout_s: float | None) -> str:
    """Name of the first test that fails, empty where all pass; a mutant that runs for ever is noticed, too."""
    with tempfile.TemporaryDirectory(prefix="mutant_") as folder:
        root, log = copy_tree(Path(folder) / "tree"), Path(folder) / "log.txt"
        if mutant:
            change(mutant, root)
        process = multiprocessing.get_context("forkserver").Process(target=run_tests, args=(str(root), tests, str(log)))
        process.start()
        process.join(timeout_s)
        if process.is_alive():
            process.kill()
            return f"no answer after {timeout_s:.0f} s"
        if process.exitcode == 0:
            return ""
        text = log.read_text() if log.exists() else ""
        found = FAILED.search(text)
        if process.exitcode != 1 or not found:
            raise RuntimeError(f"the tests of {mutant} did not run:\n{text[-3000:]}")
        return found[1]


def report(mutant: Mutant, timeout_s: float) -> bool:
    """Run one mutant and print its line; whether it was noticed."""
    begin = time.monotonic()
    killer = first_failure(mutant.tests, mutant, timeout_s)
    word, line = ("killed", killer) if killer else ("SURVIVED", f"{mutant.before!r} -> {mutant.after!r}")
    print(f"{word:8} {time.monotonic() - begin:4.0f} s  {mutant.file}: {mutant.bug}\n{'':18}{line}", flush=True)
    return bool(killer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="part of a file's name or of a bug's description")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at once")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds after which a run counts as noticed")
    arguments = parser.parse_args()
    multiprocessing.get_context("forkserver").set_forkserver_preload(HEAVY)
    mutants = collect(arguments.only)
    for tests in dict.fromkeys(mutant.tests for mutant in mutants):
        broken = first_failure(tests, None, None)
        if broken:
            sys.exit(f"without any change {broken} fails")
    with ThreadPoolExecutor(arguments.jobs) as pool:
        noticed = list(pool.map(lambda mutant: report(mutant, arguments.timeout), mutants))
    print(f"{sum(noticed)} of {len(noticed)} killed by their own tests")


if __name__ == "__main__":
    main()
