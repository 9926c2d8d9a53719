"""Draws docs/real_images.jpg and docs/real_images.webp from a polished run on real images.

The first shows frames that the splats were not fitted to, the second a flight along the path, map beside splats.

emgs run kitchen.mp4 hydra.run.dir=kitchen && emgs polish kitchen
python docs/real_images.py kitchen

kitchen.mp4: 60 images of 7-Scenes redkitchen/seq-01, every fourth of the first 240, at 7.5 a second.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from emgs_jax.config.configure import build, compose
from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.colors import to_bytes
from emgs_jax.drawing.layers import closed
from emgs_jax.drawing.splats import read_splats
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.polish.splats import draw
from emgs_jax.render.composite import render
from emgs_jax.runs.finished_run import SPLATS_FILE, read_run, render_config

TARGET = Path(__file__).with_name("real_images.jpg")
NUM_STEPS = 60  # of the flight, there; as many back
SIZE = 1.25  # of the flight's pictures, in images
GAP = 6  # pixels between pictures
MARGIN = 34  # pixels, for the words on the left


def path(poses: np.ndarray) -> np.ndarray:
    """A smooth path of `NUM_STEPS` poses along those of the frames (n, 4, 4)."""
    rows, wanted = np.arange(len(poses)), np.linspace(0, len(poses) - 1, NUM_STEPS)
    centers = gaussian_filter1d(poses[:, :3, 3], 2.0, axis=0)
    found = np.tile(np.eye(4), (NUM_STEPS, 1, 1))
    found[:, :3, 3] = np.stack([np.interp(wanted, rows, values) for values in centers.T], axis=1)
    found[:, :3, :3] = RotationSpline(rows[::3], Rotation.from_matrix(poses[::3, :3, :3]))(wanted).as_matrix()
    return found


def flight(folder: Path) -> Iterator[Image.Image]:
    """Pictures along the path: left of a line that moves the map, right of it the splats."""
    run, splats = read_run(folder), read_splats(folder / SPLATS_FILE)
    camera = run.camera
    width, height = round(SIZE * camera.width), round(SIZE * camera.height)
    camera = Camera(SIZE * camera.focal, SIZE * (camera.center + 0.5) - 0.5, width, height)
    means, covs, normals, colors = (jnp.asarray(values, jnp.float32) for values in splats)
    sharp = Gaussians(means, covs, colors[:, :3], normals, jnp.zeros((len(means), 0)), jnp.ones(len(means), bool))
    lists = build(compose("folder=x", "polish.loss.render.tile_capacity=2048", name="polish"), "polish").loss.render
    gaussians, how = closed(confirmed(run.map)), render_config(run)
    of_splats = jax.jit(lambda T: draw(sharp, colors[:, 3], T, camera, lists).values)
    of_map = jax.jit(lambda T: render(gaussians, gaussians.colors, T, camera, how).values)
    for step, pose in enumerate(path(run.poses[run.is_placed])):
        line = round(width * (0.5 - 0.45 * np.cos(4 * np.pi * step / NUM_STEPS)))
        left, right = (to_bytes(np.asarray(drawn(to_se3(pose)))) for drawn in (of_map, of_splats))
        picture = np.concatenate([left[:, :line], np.full((height, 2, 3), 255, np.uint8), right[:, line + 2 :]], axis=1)
        yield Image.fromarray(picture[:, :width])


def main(folder: Path) -> None:
    """Draw both."""
    held_out(folder)
    first, *others = [*(there := list(flight(folder))), *there[-2:0:-1]]
    first.save(TARGET.with_suffix(".webp"), save_all=True, append_images=others, duration=80, loop=0, quality=60)


def held_out(folder: Path) -> None:
    """Put the rows of polish.png, image, map and splats of a frame each, side by side as columns."""
    strip = np.asarray(Image.open(folder / "polish.png").convert("RGB"))
    run = json.loads((folder / "metrics.json").read_text())["provenance"]["data"]["frames"]["size"]
    found = json.loads((folder / "polish.json").read_text())
    (width, height), count = run, len(strip) // run[1]
    words = [
        "images that were held out",
        f"map, {found['polish/before_psnr_db']:.1f} dB",
        f"splats, {found['polish/after_psnr_db']:.1f} dB",
    ]
    page = Image.new("RGB", (MARGIN + count * (width + GAP), len(words) * (height + GAP)), "white")
    font = ImageFont.load_default(19)
    for row, text in enumerate(words):
        top = row * (height + GAP)
        label = Image.new("RGB", (height, MARGIN), "white")
        ImageDraw.Draw(label).text((height / 2, MARGIN / 2), text, "black", font, "mm")
        page.paste(label.rotate(90, expand=True), (0, top))
        for column in range(count):
            part = strip[column * height : (column + 1) * height, row * width : (row + 1) * width]
            page.paste(Image.fromarray(part), (MARGIN + column * (width + GAP), top))
    page.save(TARGET, quality=88, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
