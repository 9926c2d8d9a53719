"""`python -m tools.soak --steps 10000`: a camera that walks to and fro in a room, then scenes that are hard.

Writes curves of memory, step time, Gaussians and frames that do not fit to OUT/soak.json and OUT/soak.png, and prints
memory and step time of the last tenth over the second. The exit status is 1 where a map is poisoned, a frame has no
status or one of the two ratios is over `--max-ratio`. `--seconds` ends the walk early.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from emgs_jax.device.settings import use_compilation_cache
from emgs_jax.io.files import write_json
from emgs_jax.mapping.records import UNTRACKED

from .scenes import SCENES, ToAndFro
from .soak import Curves, faults, grown, ratio, soak

NUM_SHORT = 30  # frames of a scene
# Room for the whole walk from the start: where a map is full it is doubled and a second step compiled, some 190 MiB
# once, which is neither a leak nor slower with every frame.
ROOM = "slam.submap.map_capacity=4096", "slam.submap.submap_capacity=4096"


def draw(path: Path, curves: Curves) -> None:
    """Four curves over the frames."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    untracked = np.cumsum([status in UNTRACKED for status in curves.status])
    shown = {
        "memory, MiB": curves.memory_mb,
        "step, s (median of 20)": [np.median(curves.seconds[max(0, i - 19) : i + 1]) for i in range(len(untracked))],
        "Gaussians": curves.num_gaussians,
        "frames that do not fit, so far": untracked,
    }
    figure, axes = pyplot.subplots(len(shown), figsize=(9, 9), sharex=True, layout="constrained")
    for axis, (title, values) in zip(axes, shown.items(), strict=True):
        axis.plot(values, linewidth=0.8)
        axis.set_ylabel(title)
        axis.set_ylim(bottom=0)
    axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=100)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.soak", description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("--max-ratio", type=float, default=1.05)
    parser.add_argument("--out", type=Path, default=Path("outputs/soak"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    use_compilation_cache()
    run, curves = soak(ToAndFro(given.steps), ROOM, given.seconds)
    count = len(curves.status)
    found = {"walk": faults(run, count)}
    ratios = {"memory": ratio(curves.memory_mb), "step": ratio(curves.seconds)}
    found["walk"] += grown(ratios, given.max_ratio)
    write_json(given.out / "soak.json", {"ratios": ratios, "faults": found["walk"], "curves": vars(curves)})
    draw(given.out / "soak.png", curves)
    said = ", ".join(f"{curves.status.count(status)} {status}" for status in sorted(set(curves.status)))
    print(f"{count} frames: {said}; {curves.num_gaussians[-1]} Gaussians")
    print(f"last tenth over second tenth: memory {ratios['memory']:.3f}, step time {ratios['step']:.3f}")
    for name, (change, place) in SCENES.items():
        short, seen = soak(ToAndFro(NUM_SHORT, change, place))
        found[name] = faults(short, NUM_SHORT)
        print(f"{name}: {', '.join(f'{seen.status.count(s)} {s}' for s in sorted(set(seen.status)))}")
    for name, words in found.items():
        for word in words:
            print(f"FAULT, {name}: {word}")
    print(f"everything is in {given.out}")
    return int(any(found.values()))


if __name__ == "__main__":
    sys.exit(main())
