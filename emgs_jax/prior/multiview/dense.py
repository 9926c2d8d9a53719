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
    """Settings of a view's dense depth: what is accepted."""

    noise: DepthNoiseConfig  # standard deviation of a depth
    num_checks: int = number(4, low=0, high=64)  # views whose depth is compared with it
    # of the depths of two views, as a fraction: where they differ by so much they agree by 1/e
    depth_step: float = number(0.02, low=1e-6)
    depth_margin: float = number(1.4, low=1, high=1000)  # a depth may lie beyond the landmarks' by this factor


class Scene(NamedTuple):
    """Frames with poses."""

    dataset: Dataset
    structure: Structure
    lenses: list[Lens]  # of the worlds of the structure
    camera: Camera  # pinhole, of all frames


class Depth(NamedTuple):
    """Depth of a view, at the pixels of the pinhole camera."""

    depth: np.ndarray  # (h, w) z in the unit of the structure, 0 where it is not known
    spread: np.ndarray  # (h, w) a multiple of the standard deviation of log z, as the way to it has it
    pixels: np.ndarray  # (h, w), see `pixels_per_log_depth`; 1 where nothing was matched, 0 where there is no telling
    # of the logarithm of a factor that all depths have in common; 0 where they are triangulated
    scale_std: float = 0.0


Depths = Callable[[int], Depth]  # of a frame that the structure has placed


@dataclass(frozen=True)
class Way:
    """A way to dense depth."""

    # the structure, whose unit it may have changed, and the depth of each frame
    begin: Callable[[Scene], tuple[Structure, Depths]]
    # raises ValueError where it does not fit a data set, before anything is computed
    check: Callable[[Dataset], None] = lambda dataset: None
    contents: Mapping[str, Any] = field(default_factory=dict)  # what its files hold, for provenance


def tried_depths(z: np.ndarray, margin: float) -> np.ndarray:
    """The nearest and the farthest depth that is tried: of all landmarks but a hundredth at either end, and a margin.

    Args:
        z: depths of those that a view shows, m.
        margin: factor by which the range goes beyond theirs.
    """
    return np.float32([np.percentile(z, 1) / margin, np.percentile(z, 99) * margin])
