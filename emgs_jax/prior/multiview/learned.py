"""Dense depth by IterMVS, whose weights the user brings."""

from dataclasses import dataclass

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.pytree import stack
from emgs_jax.ops.ranges import number
from emgs_jax.prior.itermvs.network import Features, IterMVS, IterMVSConfig, Sources, estimate, extract
from emgs_jax.prior.itermvs.weights import load_weights
from emgs_jax.prior.multiview.dense import DenseConfig, Matched, Stereo
from emgs_jax.prior.multiview.lens import Lens, rectify

MULTIPLE = 32  # of pixels; the network halves its images five times
jitted_extract = eqx.filter_jit(extract)


@eqx.filter_jit
def jitted_estimate(
    network: IterMVS, matched: Matched, grid: Camera, config: IterMVSConfig
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """`estimate` of what is matched, with images of another camera."""
    sources = Sources(stack(matched.sources), matched.T_source_view, matched.is_used)
    return estimate(network, matched.view, sources, matched.depth_range, grid, config)


@dataclass(frozen=True)
class LearnedConfig(DenseConfig):
    """Depth by a network.

    Args:
        network: its sizes.
        magnification: of the images that it is shown, then rounded to what it can take.
        checkpoint: path of its weights.
        sha256: of that file, in hexadecimal digits.
    """

    network: IterMVSConfig
    magnification: float = number(low=0.01, high=16)
    checkpoint: str | None
    sha256: str


def grid_of(camera: Camera, magnification: float) -> Camera:
    """The camera of the images that the network is shown: edges lie on edges."""
    size = np.array([camera.width, camera.height])
    width, height = np.maximum(np.round(size * magnification / MULTIPLE), 1).astype(int) * MULTIPLE
    ratio = np.float32([width, height]) / np.float32(size)
    return Camera(camera.focal * ratio, (camera.center + 0.5) * ratio - 0.5, int(width), int(height))


def learned(config: LearnedConfig) -> Stereo:
    """Depth of RGB images by a network; the spread is -log of its confidence."""
    network = load_weights(config.checkpoint, config.sha256)

    def prepare(image: np.ndarray, lens: Lens) -> Features:
        shown = rectify(np.float32(image), lens) / 255.0
        grid = grid_of(Camera(lens.focal, lens.center, *image.shape[1::-1]), config.magnification)
        way = cv2.INTER_AREA if grid.width < image.shape[1] else cv2.INTER_LINEAR
        resized = cv2.resize(shown, (grid.width, grid.height), interpolation=way)
        return jitted_extract(network.features, jnp.asarray(resized))

    def depth_of(matched: Matched) -> tuple[np.ndarray, np.ndarray]:
        grid = grid_of(matched.camera, config.magnification)
        depth, confidence = map(np.asarray, jitted_estimate(network, matched, grid, config.network))
        size = matched.camera.width, matched.camera.height
        inverse, confidence = (cv2.resize(values, size) for values in (1.0 / depth, confidence))
        return 1.0 / inverse, -np.log(confidence)

    return Stereo(prepare, depth_of)
