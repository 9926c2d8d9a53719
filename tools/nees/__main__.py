"""`python -m tools.nees --runs 6`: map rooms with the simulated prior, and compare errors of poses with what is said.

With words of a run, such as `dataset=apartment dataset.stride=2 prior.version=2 graph=default`, that sequence is mapped
instead, with other seeds of the prior each time. The errors of the frames of one run depend on each other, so that a
run counts as one sample. The exit status is 1 where the mean over the runs is outside of the 95 % band of so many.
"""

import argparse
import sys

import numpy as np

import emgs_jax

from .consistency import band, consistency_of_run


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.nees", description=__doc__)
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("words", nargs="*", help="instead of a room by seed")
    given = parser.parse_args()
    found = []
    for run in range(given.runs):  # the defaults were chosen with the prior's seeds 0, 1 and 2
        words = given.words or (f"dataset.seed={run}",)
        config = emgs_jax.load_config(f"prior.seed={run + 3}", "dataset.size=[160,120]", *words)
        said = consistency_of_run(emgs_jax.map_sequence(config))
        found.append(said.mean)
        print(
            f"run {run}: NEES / 6 = {said.mean:.2f}, median {said.median:.2f}; translation {said.translation:.2f}, "
            f"rotation {said.rotation:.2f}; by direction {said.directions.round(2)}, by quarter of the path "
            f"{said.quarters.round(2)}",
            flush=True,
        )
    low, high = band(len(found))
    print(f"mean {np.mean(found):.2f}; 95 % of such means lie between {low:.2f} and {high:.2f}")
    return int(not low <= np.mean(found) <= high)


if __name__ == "__main__":
    sys.exit(main())
