"""Depth of a view by matching it with others: choose them, and cache what is kept of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.dense import DenseConfig, Depth, Depths, Scene, tried_depths
from emgs_jax.prior.multiview.depth import pixels_per_log_depth
from emgs_jax.prior.multiview.lens import Lens
from emgs_jax.prior.sources import Sources, choose, parallax, placed_beside, same_sources, sources_of
from emgs_jax.scale.estimate import Scale
from emgs_jax.structure.model import Structure

jitted_pixels = eqx.filter_jit(pixels_per_log_depth)
NUM_KEPT = 64  # frames whose images or features are cached


@dataclass(frozen=True, kw_only=True)
class MatchedConfig(DenseConfig):
    """Depth by matching a view with its sources."""

    num_sources: int = number(6, low=1, high=64)  # views that it is matched against
    best_parallax_rad: float = number(0.2, low=1e-6, high=4)  # between the rays of a landmark; more is no better


class Stereo(NamedTuple):
    """How a view is matched."""

    prepare: Callable[[np.ndarray, Lens], Any]  # RGB image (h, w, 3), uint8, and its lens -> what is kept of the view
    # The view, its sources, nearest and farthest depth to try, camera -> depth (h, w), 0 where unknown, and its spread,
    # proportional to the standard deviation of log z.
    estimate: Callable[[Any, Sources, Float[Array, "2"], Camera], tuple[np.ndarray, np.ndarray]]


def rehearse(camera: Camera, stereo: Stereo, config: MatchedConfig) -> None:
    """Compile the programs of `begin_matched`."""
    blank = np.zeros((camera.height, camera.width, 3), np.uint8)
    view = stereo.prepare(blank, Lens(camera.focal, camera.center))
    sources, depth_range = same_sources(view, config.num_sources), jnp.asarray(tried_depths(np.ones(1), 2.0))
    depth, _ = stereo.estimate(view, sources, depth_range, camera)
    jitted_pixels(jnp.asarray(depth), sources._replace(views=None), camera)


def begin_matched(scene: Scene, stereo: Stereo, config: MatchedConfig) -> tuple[Depths, Sequence[Scale]]:
    """Begin depth of each frame by stereo with its sources, which tells no scale."""

    @lru_cache(NUM_KEPT)
    def view(frame: int) -> Any:
        return stereo.prepare(scene.dataset[frame].image, scene.lens(scene.newest().world[frame]))

    def depth_of(frame: int) -> Depth:
        found = scene.newest()
        others, z = chosen(found, frame, config), found.depths(frame)
        z = z[z > 0]
        if not others or not len(z):
            nothing = np.zeros((scene.camera.height, scene.camera.width), np.float32)
            return Depth(nothing, nothing, nothing)
        sources = sources_of(found, frame, others, config.num_sources, view)
        depth_range = jnp.asarray(tried_depths(z, config.depth_margin))
        depth, spread = stereo.estimate(view(frame), sources, depth_range, scene.camera)
        pixels = jitted_pixels(jnp.asarray(depth), sources._replace(views=None), scene.camera)
        return Depth(depth, spread, np.asarray(pixels))

    return depth_of, ()


def chosen(found: Structure, frame: int, config: MatchedConfig) -> list[int]:
    """The views that together see the frame's landmarks with most parallax, best first."""
    landmarks, points, center = found.landmarks[frame], found.shown(frame), found.T_world_camera[frame, :3, 3]
    worth = {}
    for other in placed_beside(found, frame):
        is_shown = np.isin(landmarks, found.landmarks[other], assume_unique=True)
        if is_shown.any():
            angle = parallax(points, center, found.T_world_camera[other, :3, 3])
            worth[other] = is_shown * np.minimum(angle / config.best_parallax_rad, 1.0)
    return choose(worth, config.num_sources)
