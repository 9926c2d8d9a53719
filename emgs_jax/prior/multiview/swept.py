"""Dense depth without weights: plane sweep, semi-global aggregation, and planes where texture is missing."""

from dataclasses import dataclass, field

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.multiview.depth import DepthConfig, estimate_depth
from emgs_jax.prior.multiview.lens import Lens, rectify
from emgs_jax.prior.multiview.matched import MatchedConfig, Stereo
from emgs_jax.prior.multiview.planar import PlanarConfig, fill_planes
from emgs_jax.prior.sources import Sources

jitted_depth = eqx.filter_jit(estimate_depth)


@dataclass(frozen=True, kw_only=True)
class SweptConfig(MatchedConfig):
    """Depth by a plane sweep, with planes in blank regions."""

    depth: DepthConfig = field(default_factory=DepthConfig)
    planar: PlanarConfig = field(default_factory=PlanarConfig)


def swept(config: SweptConfig) -> Stereo:
    """Depth of grey images by a plane sweep; the spread is that of the plausible planes, in log z."""

    def prepare(image: np.ndarray, lens: Lens) -> np.ndarray:
        return rectify(np.float32(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) / 255.0, lens)

    def estimate(
        view: np.ndarray, sources: Sources, depth_range: Float[Array, "2"], camera: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        depth, spread = jitted_depth(jnp.asarray(view), sources, depth_range, camera, config.depth)
        near, far = np.asarray(depth_range)
        spacing = (1.0 / near - 1.0 / far) / (config.depth.sweep.num_planes - 1)
        depth, planes = fill_planes(np.asarray(depth), np.asarray(spread), view, spacing, config.planar)
        return depth, planes * spacing * depth

    return Stereo(prepare, estimate)
