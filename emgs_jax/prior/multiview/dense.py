"""Common parts of the ways to the dense depth of views whose poses are known."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.depth_noise import DepthNoiseConfig
from emgs_jax.prior.multiview.lens import Lens
from emgs_jax.structure.model import Structure


@dataclass(frozen=True, kw_only=True)
class DenseConfig:
    """Settings of a view's dense depth: what is accepted.

    Args:
        noise: standard deviation of a depth.
        num_checks: views whose depth is compared with it.
        depth_step: of the depths of two views, as a fraction: where they differ by so much they agree by 1/e.
        depth_margin: a depth may lie beyond the landmarks' by this factor.
    """

    noise: DepthNoiseConfig
    num_checks: int = number(4, low=0, high=64)
    depth_step: float = number(0.02, low=1e-6)
    depth_margin: float = number(1.4, low=1, high=1000)


class Scene(NamedTuple):
    """Frames with poses.

    Args:
        lenses: of the worlds of the structure.
        camera: pinhole, of all frames.
    """

    dataset: Dataset
    structure: Structure
    lenses: list[Lens]
    camera: Camera


class Depth(NamedTuple):
    """Depth of a view, at the pixels of the pinhole camera.

    Args:
        depth: (h, w) z in the unit of the structure, 0 where it is not known.
        spread: (h, w) a multiple of the standard deviation of log z, as the way to it has it.
        pixels: (h, w), see `pixels_per_log_depth`; 1 where nothing was matched, 0 where there is no telling.
        scale_std: of the logarithm of a factor that all depths have in common; 0 where they are triangulated.
    """

    depth: np.ndarray
    spread: np.ndarray
    pixels: np.ndarray
    scale_std: float = 0.0


Depths = Callable[[int], Depth]  # of a frame that the structure has placed


@dataclass(frozen=True)
class Way:
    """A way to dense depth.

    Args:
        begin: the structure, whose unit it may have changed, and the depth of each frame.
        check: raises ValueError where it does not fit a data set, before anything is computed.
        contents: what its files hold, for provenance.
    """

    begin: Callable[[Scene], tuple[Structure, Depths]]
    check: Callable[[Dataset], None] = lambda dataset: None
    contents: Mapping[str, Any] = field(default_factory=dict)


def tried_depths(z: np.ndarray, margin: float) -> np.ndarray:
    """The nearest and the farthest depth that is tried: of all landmarks but a hundredth at either end, and a margin.

    Args:
        z: depths of those that a view shows, m.
        margin: factor by which the range goes beyond theirs.
    """
    return np.float32([np.percentile(z, 1) / margin, np.percentile(z, 99) * margin])
