"""What became of an input: what the pose graph and the log are told of its frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from emgs_jax.slam import StepInfo

# Outcomes of relocalization, `Event.location`, as files have them.
RELOCALIZED, RESTARTED, NEW_SUBMAP, JOINED = "relocalized", "restarted", "new_submap", "joined"


@dataclass(frozen=True)
class Event:
    """Outcome of an input; its frames are more than one where a map was made from them together.

    Args:
        poses: T_world_camera (n, 4, 4) as first estimated; of a lost frame a placeholder.
        is_start: True where a map started from the frames.
        num_gaussians: in the map afterwards; None where the frame is lost.
        is_frozen: True in localization mode: nothing was fused.
        info: result of the step, on the host; None without one.
        location: outcome of relocalization, see `FrameRecord`; None without one.
        similarity: from the submap of the frame to the one with which it was joined, (4, 4).
        covariance: (6, 6) of the pose, see `FrameRecord`; None without a step.
        seconds: that it took, see `FrameRecord`.
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

    @property
    def is_tracked(self) -> bool:
        """True where the frame was registered to the map."""
        return self.info is not None and bool(self.info.localization.is_tracked)

    @property
    def is_placed(self) -> bool:
        """True where the map holds the frames."""
        return self.is_start or self.is_tracked

    @property
    def scale(self) -> float:
        """Factor on the prediction's lengths."""
        return 1.0 if self.info is None else float(self.info.localization.scale)

    @property
    def depth_noise(self) -> float | None:
        """How much the points differ from the map, as a fraction of their depth; None where none agrees."""
        is_known = self.info is not None and int(self.info.localization.icp.num_inliers)
        return float(self.info.localization.depth_noise) if is_known else None

    @property
    def origin(self) -> int | None:
        """Node whose Gaussians the frame was registered to; None where it was not."""
        return int(self.info.origin) if self.is_tracked else None
