"""Small pictures for the page: the camera's image, and the map's colours and depth from the same pose."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jaxlie
import matplotlib
import numpy as np
from PIL import Image

from emgs_jax.data.base import BadFrameError, Dataset
from emgs_jax.device.arrays import fetched, to_se3
from emgs_jax.drawing.colors import to_bytes
from emgs_jax.drawing.layers import closed
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.render.composite import RenderConfig, render
from emgs_jax.report.html import jpeg
from emgs_jax.runs.finished_run import FinishedRun
from emgs_jax.runs.moving import with_moving

WIDTH = 200  # pixels; largest width of a picture
_NO_DEPTH = (221, 221, 221)


class Picture(NamedTuple):
    """JPEGs of one frame in base64; "" for a missing one."""

    row: int
    seen: str
    rendered: str
    depth: str


class Views(NamedTuple):
    """Pictures, and the depths [m] at both ends of the colour scale."""

    pictures: list[Picture]
    near: float
    far: float


@eqx.filter_jit
def _drawn(gaussians: Gaussians, pose: jaxlie.SE3, camera: Camera, config: RenderConfig) -> tuple[jax.Array, jax.Array]:
    drawing = render(gaussians, gaussians.colors, pose, camera, config)
    return drawing.values, drawing.depth


def draw_views(run: FinishedRun, rows: Sequence[int], config: RenderConfig, dataset: Dataset | None) -> Views:
    """Render the map of a run from placed frames, beside the images of a data set."""
    small, placed = downscale(run.camera, -(-run.camera.width // WIDTH)), run.is_placed
    gaussians = closed(confirmed(run.map))
    known = [row for row in rows if placed[row]]
    drawings = fetched(_drawn(gaussians, to_se3(run.poses[row]), small, config) for row in known)
    drawn = dict(zip(known, drawings, strict=True))
    depths = [depth[depth > 0] for _, depth in drawn.values()]
    seen = np.concatenate(depths) if depths else np.zeros(0)
    near, far = (float(value) for value in np.percentile(seen, [1, 99])) if len(seen) else (0.0, 1.0)
    pictures = []
    for row in rows:
        color, depth = drawn.get(row, (None, None))
        rendered = "" if color is None else jpeg(to_bytes(color))
        seen, painted = _seen(dataset, row, run.frames[row]), "" if depth is None else jpeg(_painted(depth, near, far))
        pictures.append(Picture(row, seen, rendered, painted))
    return Views(pictures, near, far)


def _seen(dataset: Dataset | None, row: int, line: Mapping[str, Any]) -> str:
    if dataset is None:
        return ""
    try:
        image = Image.fromarray(with_moving(dataset[row].image, line))
    except (BadFrameError, OSError):  # removed since the run
        return ""
    image.thumbnail((WIDTH, WIDTH * image.height), Image.Resampling.BOX)
    return jpeg(np.asarray(image))


def _painted(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Colour depth, uint8 (h, w, 3); grey for none."""
    share = (depth - near) / max(far - near, 1e-9)
    colors = to_bytes(matplotlib.colormaps["turbo"](share)[..., :3])
    return np.where((depth > 0)[..., None], colors, np.uint8(_NO_DEPTH))
