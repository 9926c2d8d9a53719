"""Which plausible bugs do the tests notice? `python -m tools.mutants --sample 200 --seed 0 --jobs 2`.

Each mutant is one change of one file: of a sample that a generator draws, and of the few in `by_hand.py`. It is made
in a copy of the repository, where one file of tests after the other is run until a test fails: the file's own tests,
then those that import it. A failure counts if the same tests pass without the change. What became of a mutant is kept
in `--results`, and it is not tried again unless its file has changed; remove that file when tests have changed.
"""

import argparse
import collections
import json
import multiprocessing
import queue
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tools.mutants.choose import ROOT, Mutant, by_hand, digest, is_core, nearest_tests, sample
from tools.mutants.operators import changed
from tools.mutants.tree import HEAVY, Tree


class Session:
    def __init__(self, arguments: argparse.Namespace) -> None:
        self._path, self._reach = arguments.results, arguments.reach
        self._known = json.loads(self._path.read_text()) if self._path.exists() else {}
        self._is_sound: dict[str, bool] = {}
        self._lock = threading.Lock()
        self._trees: queue.Queue[Tree] = queue.Queue()

    def add_tree(self, tree: Tree) -> None:
        self._trees.put(tree)

    def killer(self, tree: Tree, mutant: Mutant, source: str) -> str:
        for test in nearest_tests(mutant.file, self._reach):
            tree.write(mutant.file, changed(source, mutant.edit))
            failure = tree.failure(test)
            tree.write(mutant.file, source)
            if failure and test not in self._is_sound:
                self._is_sound[test] = not tree.failure(test)
                if not self._is_sound[test]:
                    print(f"left out, as it fails without a change: {test}", flush=True)
            if failure and self._is_sound[test]:
                return failure
        return ""

    def result(self, mutant: Mutant) -> dict:
        """What became of a mutant; its line is printed."""
        source = (ROOT / mutant.file).read_text()
        key = digest(source, *mutant)
        if key not in self._known:
            tree, begin = self._trees.get(), time.monotonic()
            killer = self.killer(tree, mutant, source)
            self._trees.put(tree)
            found = {"mutant": str(mutant), "kind": mutant.edit.kind, "killer": killer}
            found |= {"seconds": round(time.monotonic() - begin), "is_core": is_core(mutant.file)}
            with self._lock:
                self._known[key] = found
                self._path.with_suffix(".part").write_text(json.dumps(self._known, indent=1))
                self._path.with_suffix(".part").replace(self._path)
        found = self._known[key]
        word = "killed" if found["killer"] else "SURVIVED"
        print(f"{word:8} {found['seconds']:4d} s  {found['mutant']}  {found['killer']}", flush=True)
        return found


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
    session = Session(arguments)
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        for job in range(arguments.jobs):
            session.add_tree(Tree(Path(folder) / str(job), arguments.timeout))
        found = list(pool.map(session.result, mutants))
    for name, part in (("core", True), ("host", False)):
        counts = collections.Counter(bool(one["killer"]) for one in found if one["is_core"] == part)
        print(f"{name}: {counts[True]} of {counts.total()} killed")


if __name__ == "__main__":
    main()
