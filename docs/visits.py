"""Draws docs/visits.jpg: frames of a run, and its map from there, without and with slam.existence.patience.

for patience in inf 3; do
  emgs run dataset=synthetic dataset.size=[128,96] dataset.seed=66 prior.seed=66 dataset.movers=2 \
    slam.existence.patience=$patience hydra.run.dir=patience_$patience
done
python docs/visits.py patience_inf patience_3 24 30 36
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from emgs_jax.config.configure import build_dataset, compose
from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.colors import to_bytes
from emgs_jax.drawing.layers import closed
from emgs_jax.gaussian_map import confirmed
from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import render
from emgs_jax.runs.finished_run import FinishedRun, read_run, render_config
from emgs_jax.runs.repeat import repeat

TARGET = Path(__file__).with_name("visits.jpg")
SIZE = 2.5  # of the pictures, in images
GAP = 6  # pixels between pictures


def seen(run: FinishedRun, row: int) -> np.ndarray:
    """The map of a run from the pose of a frame, white where it has nothing, uint8 (height, width, 3)."""
    camera = run.camera
    size = round(SIZE * camera.width), round(SIZE * camera.height)
    camera = Camera(SIZE * camera.focal, SIZE * (camera.center + 0.5) - 0.5, *size)
    gaussians = closed(confirmed(run.map))
    drawn = render(gaussians, gaussians.colors, to_se3(run.poses[row]), camera, render_config(run))
    return to_bytes(np.asarray(drawn.values + (1.0 - drawn.alpha)[..., None] * jnp.ones(3)))


def main(without: Path, with_: Path, rows: Sequence[int]) -> None:
    """A column for each frame: its image, the map without, the map with."""
    runs = read_run(without), read_run(with_)
    dataset = build_dataset(compose(*repeat(runs[0].provenance["config"]).words))
    columns = []
    for row in rows:
        maps = [seen(run, row) for run in runs]
        image = Image.fromarray(dataset[row].image).resize(maps[0].shape[1::-1], Image.Resampling.LANCZOS)
        columns.append(_beside([np.asarray(image), *maps], axis=0))
    Image.fromarray(_beside(columns, axis=1)).save(TARGET, quality=88, optimize=True)


def _beside(pictures: Sequence[np.ndarray], axis: int) -> np.ndarray:
    gap = np.full_like(pictures[0].take(range(GAP), axis), 255)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), [int(word) for word in sys.argv[3:]])
