"""What streams by while a sequence is mapped, gathered for comparison: what the prior alone says."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds
from emgs_jax.evaluation.reconstruction import EvaluationConfig, posed_cloud
from emgs_jax.io.spool import Spool
from emgs_jax.running.inputs import RawView


@dataclass(frozen=True)
class RawPrior:
    """What the prior alone says of a sequence.

    Args:
        cloud: its points at its poses, averaged per voxel.
        depths: camera-space z of each frame (h, w), in the prior's own lengths; 0 where it says none.
    """

    cloud: PointCloud
    depths: Spool


def gather(views: Iterable[RawView], evaluation: EvaluationConfig, keeps_depths: bool) -> RawPrior:
    """Take all views of a sequence, one after the other; depths are of use where the truth is known."""
    depths = Spool()

    def clouds() -> Iterator[PointCloud]:
        for view in views:
            if keeps_depths:
                depths.append(np.where(view.mask, view.points[..., 2], 0.0).astype(np.float32))
            yield posed_cloud(*view, evaluation)

    return RawPrior(fuse_clouds(clouds(), evaluation.voxel_m), depths)
