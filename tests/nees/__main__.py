"""`python -m tests.nees --rooms 6`: map rooms with the simulated prior, and compare errors of poses with what is said.

The errors of the frames of one room depend on each other, so that a room counts as one sample. The exit status is 1
where the mean over the rooms is outside of the 95 % band of so many samples.
"""

import argparse
import sys

import numpy as np

import emgs_jax

from .consistency import band, nees_of_run


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.nees", description=__doc__)
    parser.add_argument("--rooms", type=int, default=6)
    given = parser.parse_args()
    found = []
    for room in range(given.rooms):  # the defaults were chosen with the prior's seeds 0, 1 and 2
        words = f"dataset.seed={room}", f"prior.seed={room + 3}", "dataset.size=[160,120]"
        found.append(nees_of_run(emgs_jax.map_sequence(emgs_jax.load_config(*words))))
        print(f"room {room}: NEES / 6 = {found[-1]:.2f}", flush=True)
    low, high = band(len(found))
    print(f"mean {np.mean(found):.2f}; 95 % of such means lie between {low:.2f} and {high:.2f}")
    return int(not low <= np.mean(found) <= high)


if __name__ == "__main__":
    sys.exit(main())
