"""Plausible bugs, and whether the tests notice them: `python -m tools.mutants --sample 200 --seed 0 --jobs 2`.

Each mutant is one change of one file: of a sample that a generator draws, and of the few in `by_hand.py`. It is made
in a copy of the repository, where one file of tests after the other is run until a test fails: the file's own tests,
then those that import it, and among those as near the quickest first. A failure counts if the same test passes without
the change. What became of a mutant is kept in `--results`: a later call tries it again where its file has changed, and
with the tests that have changed where it survived.
"""

import argparse
import collections
import functools
import json
import multiprocessing
import queue
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tools.mutants.choose import ROOT, Mutant, by_hand, digest, home, is_core, nearest_tests, sample
from tools.mutants.operators import changed
from tools.mutants.tree import HEAVY, Tree

UNKNOWN_S = 10.0  # what a file of tests may take that no mutant has passed yet


class Session:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._known = json.loads(path.read_text()) if path.exists() else {}
        self._sound: set[str] = set()  # tests, and files of them, that pass without a change
        self._lock = threading.Lock()
        self._trees: queue.Queue[Tree] = queue.Queue()

    def add_tree(self, tree: Tree) -> None:
        self._trees.put(tree)

    def result(self, mutant: Mutant, reach: int) -> dict:
        """Test a mutant by the tests at most `reach` imports away; a line is printed where there were new ones."""
        source = (ROOT / mutant.file).read_text()
        new = {"mutant": str(mutant), "is_core": is_core(mutant.file), "killer": "", "seconds": 0.0, "passed": {}}
        with self._lock:
            found = self._known.setdefault(digest(source, *mutant), new)
        tree, tests = self._trees.get(), self._next_tests(mutant, reach, found)
        for test in tests:
            begin = time.monotonic()
            killer = self._failure(tree, test, mutant, source)
            if killer is None:
                continue
            self._keep(found, test, killer, round(time.monotonic() - begin, 1))
            if killer:
                break
        self._trees.put(tree)
        if tests:
            word = "killed" if found["killer"] else f"passed {reach}"
            print(f"{word:8} {found['seconds']:4.0f} s  {found['mutant']}  {found['killer']}", flush=True)
        return found

    def _next_tests(self, mutant: Mutant, reach: int, found: dict) -> list[str]:
        """Those that it has not passed as they are now: of its own folder, then of others, the quickest first."""
        if found["killer"]:
            return []
        tests = [
            test
            for test in nearest_tests(mutant.file, reach)
            if found["passed"].get(test, [""])[0] != digest((ROOT / test).read_text())
        ]
        with self._lock:
            seconds = {test: took for one in self._known.values() for test, (_, took) in one["passed"].items()}
        return sorted(tests, key=lambda test: (Path(test).parent != home(mutant.file), seconds.get(test, UNKNOWN_S)))

    def _failure(self, tree: Tree, test: str, mutant: Mutant, source: str) -> str | None:
        """The first test of a file that fails with the change; empty where all pass, None where it fails without."""
        tree.write(mutant.file, changed(source, mutant.edit))
        failure = tree.failure(test)
        tree.write(mutant.file, source)
        if not failure or test in self._sound or failure in self._sound:
            self._sound.add(failure or test)
            return failure
        if tree.failure(failure if "::" in failure else test):
            print(f"left out, as it fails without a change: {failure}", flush=True)
            return None
        self._sound.add(failure)
        return failure

    def _keep(self, found: dict, test: str, killer: str, seconds: float) -> None:
        with self._lock:
            found["killer"] = killer
            found["seconds"] += seconds
            if not killer:
                found["passed"][test] = [digest((ROOT / test).read_text()), seconds]
            self._path.with_suffix(".part").write_text(json.dumps(self._known, indent=1))
            self._path.with_suffix(".part").replace(self._path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", type=int, default=200, help="so many, half of them of the core (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="another one draws others")
    parser.add_argument("--only", default="", help="of these, those whose line contains this")
    parser.add_argument("--reach", type=int, default=2, help="tests at most so many imports away (default: 2)")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at once")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds after which a file counts as failed")
    parser.add_argument("--results", type=Path, default=Path("build/mutants.json"))
    parser.add_argument("--list", action="store_true", help="say which, run nothing")
    arguments = parser.parse_args()
    mutants = [one for one in [*by_hand(), *sample(arguments.sample, arguments.seed)] if arguments.only in str(one)]
    if arguments.list:
        print(*(f"{one}  {' '.join(nearest_tests(one.file, 1)[:3])}" for one in mutants), sep="\n")
        return
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    multiprocessing.get_context("forkserver").set_forkserver_preload(HEAVY)
    session = Session(arguments.results)
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        for job in range(arguments.jobs):
            session.add_tree(Tree(Path(folder) / str(job), arguments.timeout))
        for reach in range(arguments.reach + 1):  # what is near is tried with all before what is far with any
            found = list(pool.map(functools.partial(session.result, reach=reach), mutants))
    for one in found:
        if not one["killer"]:
            print(f"SURVIVED {one['mutant']}")
    for name, part in (("core", True), ("host", False)):
        counts = collections.Counter(bool(one["killer"]) for one in found if one["is_core"] == part)
        print(f"{name}: {counts[True]} of {counts.total()} killed")


if __name__ == "__main__":
    main()
