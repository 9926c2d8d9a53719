"""Dense depth by METER, a small monocular network, whose weights the user brings."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.dense import Depths, Scene, Way
from emgs_jax.prior.multiview.lens import rectify
from emgs_jax.prior.multiview.monocular import MonocularConfig, begin_monocular
from emgs_jax.prior.pretrained.meter import SOURCE, build_network, predict
from emgs_jax.prior.pretrained.weights import load_network
from emgs_jax.scale.estimate import Scale

NUM_KEPT = 64  # frames whose depths are cached
METRES = 0.01  # of a unit of its depths, by the camera of NYU Depth v2; other focal lengths see all sizes as larger
FOCAL = 207.7  # of that camera, in pixels of an image of 256×192
jitted_predict = eqx.filter_jit(predict)


@dataclass(frozen=True, kw_only=True)
class MeterConfig(MonocularConfig):
    """Depth by METER."""

    width: int = number(256, low=64, high=4096)  # of its input images, a multiple of 64
    height: int = number(192, low=64, high=4096)
    metric_std: float = number(0.5, low=1e-3, high=10)  # of six scenes, docs/measurements/metres.md
    checkpoint: str | None  # path of its weights
    sha256: str  # of that file, hexadecimal


def way_of_meter(config: MeterConfig) -> Way:
    """Depth by METER; ValueError unless the file holds the published weights."""
    network = load_network(config.checkpoint, config.sha256, SOURCE, None, build_network)

    def begin(scene: Scene) -> tuple[Depths, Sequence[Scale | None]]:
        size = scene.camera.width, scene.camera.height
        sides = np.array([config.width, config.height]) / size
        metres = METRES * float(np.prod(sides * np.float64(scene.camera.focal) / FOCAL) ** 0.5)

        @lru_cache(NUM_KEPT)
        def values(frame: int) -> np.ndarray:
            lens = scene.lens(scene.newest().world[frame])
            shown = rectify(np.float32(scene.dataset[frame].image), lens) / 255.0
            shown = cv2.resize(shown, (config.width, config.height), interpolation=cv2.INTER_AREA)
            return metres * cv2.resize(np.asarray(jitted_predict(network, jnp.asarray(shown))), size)

        return begin_monocular(scene, values, config)

    return Way(begin, needs_all=True)
