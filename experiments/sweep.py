"""A grid of settings on one sequence: `python -m experiments.sweep sweep=gates dataset=… prior=…`.

The axes are keys of a stage, from conf/sweep/ or the command line: `'axes={slam.em.noise:[0,1]}'`. Frames, predictions
and the truth are made once for the whole grid. An interrupted sweep goes on with the same command and `hydra.run.dir=`
its folder.
"""

import shlex
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from emgs_jax.device.clock import Clock
from emgs_jax.io.files import owned, write_file
from emgs_jax.report.columns import csv_text
from emgs_jax.report.sweep_page import draw, table, write_sweep_page

from .command import command
from .grid import notes, read_axes, variants
from .together import Measured, refuse_other_maps, resumed


def sweep(config: DictConfig, folder: Path, command_line: str = "") -> list[dict[str, Any]]:
    """Map and score every setting of `config.axes` that `folder` has not; returns a flat row for each.

    The page says that `command_line` repeats it.
    """
    refuse_other_maps(config, "a sweep")
    axes = read_axes(config)
    grid = variants(config, axes)
    for note in notes(config, axes):
        print(note)
    with owned(folder), Clock().watching() as clock:
        sequence = Measured(config, folder, clock, has_pictures=True)
        num_done = sum(variant.setting in sequence for variant in grid)
        if num_done:
            print(f"going on: {len(grid) - num_done} of {len(grid)} settings are left")
        num_left = sequence.measure(grid)
        sequence.forget_predictions()
    rows, name = sequence.rows([variant.setting for variant in grid]), sequence.dataset.name
    write_file(folder / "sweep.csv", csv_text(rows))
    if config.grid == "product":  # else most cells of a picture would be empty
        title = f"{name} {sequence.dataset.sequence}, {sequence.prior.provenance.name}"
        no_picture = draw(folder / "heat_map.png", rows, axes, title, name)
        if no_picture:
            print(f"no heat_map.png: {no_picture}")
    write_sweep_page(folder, sequence.provenance, rows, list(axes), command_line)
    print(table(rows, list(axes), name))
    print(f"{num_left} settings in {clock.total_seconds:.1f} s, {clock.compile_seconds:.1f} s of it compilation")
    return rows


@command("sweep")
def main(config: DictConfig) -> None:
    """Sweep, and say where the results are."""
    with resumed() as folder:
        sweep(config, folder, shlex.join(["emgs", "sweep", *HydraConfig.get().overrides.task]))
    print(f"everything is in {folder}, report.html shows it")


if __name__ == "__main__":
    main()
