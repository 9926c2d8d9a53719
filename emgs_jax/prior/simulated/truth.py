"""The truth that is disturbed: whether the frames of a window have it."""

from collections.abc import Collection, Sequence

import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.prior.base import Window


def no_truth(what: str) -> str:
    return f"prior=simulated needs a data set with ground truth; use prior=recorded or another data set: {what}"


def check_frames(window: Window, frames: Sequence[Frame], needed: Collection[int]) -> dict[int, Frame]:
    """Return the frames by index; raise ValueError naming the first one whose truth cannot be used.

    Args:
        needed: indices of the frames whose depth is looked at.
    """
    indices = tuple(frame.index for frame in frames)
    if indices != window.views:
        raise ValueError(f"frames must be those of window.views {window.views} in that order, got {indices}")
    for frame in frames:
        label, pose, depth = f"frame {frame.index} ({frame.name})", frame.T_world_camera, frame.depth
        if pose is None:
            raise ValueError(no_truth(f"{label} has no true pose"))
        if np.shape(pose) != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"the true pose of {label} must be a finite (4, 4) matrix: leave the frame out")
        if frame.index in needed and depth is None:
            raise ValueError(no_truth(f"{label} has no depth"))
        if depth is not None and depth.shape != frame.image.shape[:2]:
            raise ValueError(
                f"the depth of {label} must have its image's size {frame.image.shape[:2]}, got {depth.shape}"
            )
    if window.inference == 0 and not any((frame.depth > 0).any() for frame in frames if frame.index in needed):
        raise ValueError(
            no_truth(
                f"0 of the first {len(needed)} images, from {frames[0].name} on, have a true depth: it is 0 everywhere"
            )
        )
    return dict(zip(indices, frames, strict=True))
