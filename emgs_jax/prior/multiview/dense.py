"""Common parts of the ways to a view's dense depth: which views it is matched with, and what is accepted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jaxlie
import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.depth_noise import DepthNoiseConfig
from emgs_jax.prior.multiview.lens import Lens


@dataclass(frozen=True)
class DenseConfig:
    """Settings of a view's dense depth: its source views and acceptance.

    Args:
        noise: standard deviation of a depth.
        num_sources: views that it is matched against.
        best_parallax_rad: between the rays of a landmark, beyond which more is no better.
        num_checks: views whose depth is compared with it.
        depth_step: of the depths of two views, as a fraction: where they differ by so much they agree by 1/e.
        depth_margin: the range of depths that is tried goes beyond the landmarks' by this factor.
    """

    noise: DepthNoiseConfig
    num_sources: int = number(low=1, high=64)
    best_parallax_rad: float = number(low=1e-6, high=4)
    num_checks: int = number(low=0, high=64)
    depth_step: float = number(low=1e-6)
    depth_margin: float = number(low=1, high=1000)


class Matched(NamedTuple):
    """A view and those that it is matched with.

    Args:
        view: what `Stereo.prepare` made of its image.
        sources: likewise; `num_sources` of them.
        T_source_view: view -> source, batched like `sources`.
        is_used: (s,) sources that count; the others are repetitions.
        depth_range: nearest and farthest depth that is tried, m.
        camera: of all views.
    """

    view: Any
    sources: Sequence[Any]
    T_source_view: jaxlie.SE3
    is_used: np.ndarray
    depth_range: np.ndarray
    camera: Camera


class Stereo(NamedTuple):
    """A way to dense depth.

    Args:
        prepare: RGB image (h, w, 3), uint8, and its lens -> what is kept of the view.
        estimate: depth (h, w) in metres, 0 where it is not known, and the spread of what its cost curve takes
            for plausible, a multiple of the standard deviation of log z.
    """

    prepare: Callable[[np.ndarray, Lens], Any]
    estimate: Callable[[Matched], tuple[np.ndarray, np.ndarray]]
