"""Run times of stages, of a registration beside Open3D's, of many settings: `python -m experiments.benchmark`.

Compilation and run time apart, everything in turns on the same data; the tables are printed and written to benchmark.md
and benchmark.json in Hydra's folder. The parts: stages, icp, sweep.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import jax
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.config.configure import build_dataset, build_prior
from emgs_jax.io.files import write_file, write_json
from emgs_jax.report.columns import Table, markdown
from emgs_jax.report.provenance import provenance

from .benchmarks.data import load
from .benchmarks.registration import time_icp
from .benchmarks.stages import time_settings, time_stages
from .benchmarks.timing import Timing, spread
from .command import command


def parts(config: DictConfig) -> dict[str, Callable[[], Iterable[Timing]]]:
    """Return the benchmarks that can be chosen, by name."""
    chosen = config.benchmark
    turns = chosen.repetitions
    return {
        "stages": lambda: time_stages(load(config), turns),
        "icp": lambda: time_icp(load(config), tuple(chosen.icp_offset), turns),
        "sweep": lambda: time_settings(load(config), chosen.num_settings, turns),
    }


def benchmark(config: DictConfig, folder: Path) -> list[Timing]:
    """Time the chosen parts and write the tables after each of them."""
    known = parts(config)
    unknown = set(config.parts) - set(known)
    if unknown or not config.parts:
        raise ValueError(f"parts must be some of {', '.join(known)}; got {', '.join(sorted(unknown)) or 'none'}")
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    about = provenance(OmegaConf.to_container(config, resolve=True), dataset, prior.provenance)
    timings: list[Timing] = []
    for name in tqdm(config.parts, unit="part", desc="timing"):
        timings += known[name]()
        write_json(folder / "benchmark.json", {"provenance": about, "timings": timings})
        write_file(folder / "benchmark.md", report(timings) + "\n")
    return timings


def report(timings: Sequence[Timing]) -> str:
    """Markdown: a table for each part, with the device above; times are medians with their range."""
    device = jax.devices()[0]
    lines = [f"{device.device_kind} ({device.platform}), {os.cpu_count()} CPU cores, jax {jax.__version__}"]
    for part, rows in groupby(timings, lambda timing: timing.part):
        titles = [part, "compile [s]", "run [ms]", "faster by", ""]
        lines += ["", markdown(Table(titles, [_cells(timing) for timing in rows])).rstrip()]
    return "\n".join(lines)


def _cells(timing: Timing) -> list[str]:
    facts = dict(timing.facts)
    ratios = facts.pop("times_faster_than", {})
    compile_seconds = "–" if timing.compile_seconds is None else f"{timing.compile_seconds:.1f}"
    run = _text(spread([1e3 * seconds for seconds in timing.seconds]))
    faster = "; ".join(f"{_text(ratio)} × {name}" for name, ratio in ratios.items()) or "–"
    rest = ", ".join(f"{name} {_text(value)}" for name, value in facts.items())
    return [timing.name, compile_seconds, run, faster, rest]


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        middle, low, high = value
        return f"{middle:.3g} ({low:.3g}–{high:.3g})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@command("benchmark")
def main(config: DictConfig) -> None:
    """Time, print the tables and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    timings = benchmark(config, folder)
    print(report(timings))
    print(f"everything is in {folder}")


if __name__ == "__main__":
    main()
