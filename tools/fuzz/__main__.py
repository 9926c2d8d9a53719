"""`python -m tools.fuzz --cases 10000 --seed 0`: damage inputs at random, read them, and count what came of it.

Every verdict is `read`, `clear error` or `fault`; with a fault the exit status is 1. `--first N --cases 1` repeats one.
"""

import argparse
import faulthandler
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tqdm import tqdm

from .cases import FAULT, print_case, run_case, run_cases
from .targets import targets

LIMIT = 120.0  # seconds after which a case that does not return ends its process


def inside(first: int, count: int, seed: int) -> None:
    """The cases themselves, a line each."""
    kinds = list(targets())
    with tempfile.TemporaryDirectory() as sound:
        for number in range(first, first + count):
            faulthandler.dump_traceback_later(LIMIT, exit=True)
            print_case(run_case(number, seed, kinds, Path(sound)))
    faulthandler.cancel_dump_traceback_later()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.inside:
        inside(given.first, given.cases, given.seed)
        return 0
    counts: Counter = Counter()
    for case in tqdm(run_cases(given.first, given.cases, given.seed), total=given.cases, unit="case"):
        counts[case.target, case.verdict] += 1
        if case.verdict == FAULT:
            tqdm.write(f"case {case.number}, seed {given.seed}: {case.target}, {case.damage}\n{case.message}\n")
    for (target, verdict), count in sorted(counts.items()):
        print(f"{target:18} {verdict:12} {count}")
    faults = sum(count for (_, verdict), count in counts.items() if verdict == FAULT)
    print(f"{faults} faults in {given.cases} cases, seed {given.seed}")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
