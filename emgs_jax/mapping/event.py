"""Outcome of an input, from which the pose graph and the log of its frames are made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from emgs_jax.existence import Seen
from emgs_jax.slam import StepInfo

# Outcomes of relocalization, `Event.location`, as written in files.
RELOCALIZED, RESTARTED, NEW_SUBMAP, JOINED = "relocalized", "restarted", "new_submap", "joined"


@dataclass(frozen=True)
class Event:
    """Outcome of an input; it has several frames if a map was made from them together.

    Args:
        poses: T_world_camera (n, 4, 4) as first estimated; a placeholder for a lost frame.
        is_start: True if a map started from the frames.
        num_gaussians: in the map afterwards; None if the frame is lost.
        is_frozen: True in localization mode: nothing was fused.
        info: result of the step, on the host; None without one.
        location: outcome of relocalization, see `FrameRecord`; None without one.
        similarity: from the submap of the frame to the one that it was joined with, (4, 4).
        covariance: (6, 6) of the pose, see `FrameRecord`; None without a step.
        seconds: that it took, see `FrameRecord`.
        seen: the last frames of a submap that is joined, see `end_looks`.
    """

    poses: np.ndarray
    is_start: bool = False
    num_gaussians: int | None = None
    is_frozen: bool = False
    info: StepInfo | None = None
    location: str | None = None
    similarity: np.ndarray | None = None
    covariance: np.ndarray | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    seen: Sequence[Seen] = ()

    @property
    def is_tracked(self) -> bool:
        """True if the frame was registered to the map."""
        return self.info is not None and bool(self.info.localization.is_tracked)

    @property
    def is_placed(self) -> bool:
        """True if the map holds the frames."""
        return self.is_start or self.is_tracked

    @property
    def scale(self) -> float:
        """Factor on the prediction's lengths."""
        return 1.0 if self.info is None else float(self.info.localization.scale)

    @property
    def depth_noise(self) -> float | None:
        """Difference of the points from the map, as a fraction of their depth; None if none agrees."""
        is_known = self.info is not None and int(self.info.localization.icp.num_inliers)
        return float(self.info.localization.depth_noise) if is_known else None

    @property
    def origin(self) -> int | None:
        """Node whose Gaussians the frame was registered to; None if it was not registered."""
        return int(self.info.origin) if self.is_tracked else None
