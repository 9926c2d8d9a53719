"""Types shared by the methods for dense depth of views with known poses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.depth_noise import DepthNoiseConfig
from emgs_jax.prior.multiview.lens import Lens
from emgs_jax.scale.estimate import Scale
from emgs_jax.structure.model import Structure


@dataclass(frozen=True, kw_only=True)
class DenseConfig:
    """Which depths of a view are accepted."""

    noise: DepthNoiseConfig  # standard deviation of a depth
    num_checks: int = number(4, low=0, high=64)  # views whose depth is compared with it
    depth_step: float = number(0.02, low=1e-6)  # relative difference at which depths of two views agree by 1/e
    depth_margin: float = number(1.4, low=1, high=1000)  # factor by which a depth may lie beyond the landmarks'


class Scene(NamedTuple):
    """Frames with poses."""

    dataset: Dataset
    newest: Callable[[], Structure]  # of the frames that have come
    lens: Callable[[int], Lens]  # of a world
    camera: Camera  # pinhole camera of all frames


class Depth(NamedTuple):
    """Depth of a view, at the pixels of the pinhole camera."""

    depth: np.ndarray  # (h, w) z in the structure's unit, 0 where unknown
    spread: np.ndarray  # (h, w) proportional to the standard deviation of log z
    pixels: np.ndarray  # (h, w), see `pixels_per_log_depth`; 1 where nothing was matched, 0 where depth is undetermined
    scale_std: float = 0.0  # of the log of a common factor of all depths; 0 if triangulated


Depths = Callable[[int], Depth]  # of a frame that the structure has placed


@dataclass(frozen=True)
class Way:
    """A method for dense depth."""

    # The frames' depths, and the scale of each world by depths in metres, None where they say nothing.
    begin: Callable[[Scene], tuple[Depths, Sequence[Scale | None]]]
    check: Callable[[Dataset], None] = lambda dataset: None  # raises ValueError if it does not fit a data set
    rehearse: Callable[[Camera], None] = lambda camera: None  # compiles its programs, before images come
    needs_all: bool = False  # one fit to all frames, which an online structure does not have
    contents: Mapping[str, Any] = field(default_factory=dict)  # digest of its files, for provenance


def tried_depths(z: np.ndarray, margin: float) -> np.ndarray:
    """Nearest and farthest depth to try: the landmarks' z from the 1st to the 99th percentile, extended by a factor."""
    return np.float32([np.percentile(z, 1) / margin, np.percentile(z, 99) * margin])
