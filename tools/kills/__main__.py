"""`python -m tools.kills --kills 50 --seed 0`: stop programs with SIGKILL, SIGTERM and SIGINT at random times.

Runs without and with a back end, a run of `multiview_stereo`, a sweep and a search, in turn.

After each stop every file that is there must be whole, and nothing of an earlier run lost; the same command must then
come to the same bits of map, trajectory, clouds, log and metrics (all but times) as a run that nobody stopped. With a
fault the exit status is 1 and the folder stays. `--first N --kills 1` repeats one.
"""

import argparse
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tqdm import tqdm

from .stops import PROGRAMS, run_case, run_whole


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # programs inherit that it is ignored in the background
    work, faults, counts = Path(tempfile.mkdtemp(prefix="kills")), 0, Counter()
    wholes = {}
    for number in tqdm(range(given.first, given.first + given.kills), unit="run"):
        variant = number % len(PROGRAMS)
        if variant not in wholes:
            wholes[variant] = run_whole(work / f"whole_{variant}", PROGRAMS[variant])
        folder = work / f"run_{number}"
        case = run_case(number, given.seed, wholes[variant], PROGRAMS[variant], folder)
        counts.update(stop.split()[0] for stop in case.stops)
        for stop in case.stops:
            tqdm.write(f"run {number}: {stop}")
        for fault in case.faults:
            tqdm.write(f"run {number}, FAULT: {fault} (in {folder})")
        if case.faults:
            faults += 1
        else:
            shutil.rmtree(folder)
    told = ", ".join(f"{count} by {name}" for name, count in sorted(counts.items()))
    print(f"{faults} of {given.kills} runs with a fault, seed {given.seed}; stopped {told}")
    if not faults:
        shutil.rmtree(work)
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
