"""Dense depth by a multi-view stereo network, whose weights the user brings."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.lens import Lens, rectify
from emgs_jax.prior.multiview.matched import MatchedConfig, Stereo
from emgs_jax.prior.pretrained import itermvs
from emgs_jax.prior.pretrained.itermvs import IterMVSConfig
from emgs_jax.prior.pretrained.weights import load_network
from emgs_jax.prior.sources import Sources

MULTIPLE = 32  # of the sides; the network halves its images five times

jitted = cache(eqx.filter_jit)  # shared by all priors of a process


@dataclass(frozen=True, kw_only=True)
class LearnedConfig(MatchedConfig):
    """Depth by a network."""

    network: IterMVSConfig = field(default_factory=IterMVSConfig)
    magnification: float = number(1.0, low=0.01, high=16)  # of its input images, whose sides are rounded
    checkpoint: str | None  # path of its weights
    sha256: str  # of that file, hexadecimal


def grid_of(camera: Camera, magnification: float) -> Camera:
    """The camera of the network's input images; image borders stay borders."""
    size = np.array([camera.width, camera.height])
    width, height = np.maximum(np.round(size * magnification / MULTIPLE), 1).astype(int) * MULTIPLE
    ratio = np.float32([width, height]) / np.float32(size)
    return Camera(camera.focal * ratio, (camera.center + 0.5) * ratio - 0.5, int(width), int(height))


def learned(config: LearnedConfig) -> Stereo:
    """Depth of RGB images by a network; the spread is -log of its confidence."""
    network = load_network(config.checkpoint, config.sha256, itermvs.SOURCE, "model", itermvs.build_network)

    def prepare(image: np.ndarray, lens: Lens) -> Any:
        shown = rectify(np.float32(image), lens) / 255.0
        grid = grid_of(Camera(lens.focal, lens.center, *image.shape[1::-1]), config.magnification)
        way = cv2.INTER_AREA if grid.width < image.shape[1] else cv2.INTER_LINEAR
        resized = cv2.resize(shown, (grid.width, grid.height), interpolation=way)
        return jitted(itermvs.extract)(network, jnp.asarray(resized))

    def depth_of(
        view: Any, sources: Sources, depth_range: Float[Array, "2"], camera: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        grid, size = grid_of(camera, config.magnification), (camera.width, camera.height)
        found = jitted(itermvs.estimate)(network, view, sources, depth_range, grid, config.network)
        depth, confidence = map(np.asarray, found)
        inverse, confidence = (cv2.resize(values, size) for values in (1.0 / depth, confidence))
        return 1.0 / inverse, -np.log(confidence)

    return Stereo(prepare, depth_of)
