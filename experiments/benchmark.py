"""Run times of stages, of a registration beside Open3D's, in turns: `python -m experiments.benchmark`.

Compilation and run time apart, everything in turns on the same data; the tables are printed and written to benchmark.md
and benchmark.json in Hydra's folder. The parts: stages, icp.
"""

import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import jax
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.config.configure import build_dataset, build_prior
from emgs_jax.io.files import write_file, write_json
from emgs_jax.ops.executable import calling
from emgs_jax.ops.precision import full_precision
from emgs_jax.report.columns import Table, markdown
from emgs_jax.report.provenance import provenance
from emgs_jax.slam import step

from .benchmark_icp import time_icp
from .command import command
from .timing import Data, Timing, called, interleaved, load, spread


def benchmark(config: DictConfig, folder: Path) -> list[Timing]:
    """Time the chosen parts and write the tables after each of them."""
    chosen = config.benchmark
    turns = chosen.repetitions
    known = {
        "stages": lambda: time_stages(load(config), turns),
        "icp": lambda: time_icp(load(config), tuple(chosen.icp_offset), turns),
    }
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


def time_stages(data: Data, repetitions: int) -> list[Timing]:
    """Every executable of a step, called with what those before it give, and the whole step."""
    given, candidates = (data.state, data.prediction, data.camera, data.config), {}

    def note(executable: Any, *arguments: Any) -> Any:
        name = executable.__wrapped__.__name__.strip("_").replace("_", " ")
        candidates[name] = called(full_precision(executable), *arguments)
        return candidates[name].call()

    with calling(note):
        step(*given)
    return interleaved("stages", candidates | {"whole step": called(step, *given)}, repetitions)


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
    return [timing.name, compile_seconds, run, faster, ", ".join(f"{key} {_text(fact)}" for key, fact in facts.items())]


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        middle, low, high = value
        return f"{middle:.3g} ({low:.3g}–{high:.3g})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@command("benchmark")
def main(config: DictConfig) -> None:
    """Time, print the tables and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    print(report(benchmark(config, folder)))
    print(f"everything is in {folder}")


if __name__ == "__main__":
    main()
