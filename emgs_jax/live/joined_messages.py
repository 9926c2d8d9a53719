"""Join the messages of one moment: an image, its depth, and the pose between two messages of odometry."""

from bisect import bisect_left
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

MAX_APART_S = 0.02  # from an image to its depth
MAX_GAP_S = 0.5  # between two poses between which one is interpolated
MAX_WAITING = 60  # messages of each kind; an image that nothing fits is left out by then


class Joined:
    """Images that wait for what belongs to them.

    Args:
        kinds: what an image needs beside it: "depth" and "pose", one of them, or none.

    Attributes:
        num_alone: images that were left out because something did not come.
    """

    def __init__(self, kinds: set[str]) -> None:
        self._kinds, self.num_alone = kinds, 0
        self._waiting: dict[str, list[tuple[float, Any]]] = {kind: [] for kind in ("image", *kinds)}

    def add(self, kind: str, time_s: float, value: Any) -> Iterator[tuple[float, dict[str, Any]]]:
        """Add a message of an "image", a "depth" or a "pose" (4, 4); yield what is whole, in order of time."""
        kept = self._waiting[kind]
        kept.insert(bisect_left(kept, time_s, key=lambda item: item[0]), (time_s, value))
        images = self._waiting["image"]
        if kind != "image" and len(kept) > MAX_WAITING:
            del kept[0]
        for place, (image_time, image) in enumerate(images):
            found = {kind: self._at(kind, image_time) for kind in self._kinds}
            if all(value is not None for value in found.values()):
                self.num_alone += place  # later ones are whole, so these will not be
                del images[: place + 1]
                yield image_time, {"image": image, **found}
                yield from self._rest()
                return
        if len(images) > MAX_WAITING:
            self.num_alone += 1
            del images[0]

    def _rest(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yield later images that are whole, too."""
        images = self._waiting["image"]
        while images:
            found = {kind: self._at(kind, images[0][0]) for kind in self._kinds}
            if any(value is None for value in found.values()):
                return
            time_s, image = images.pop(0)
            yield time_s, {"image": image, **found}

    def _at(self, kind: str, time_s: float) -> Any | None:
        kept = self._waiting[kind]
        times = [time for time, _ in kept]
        if kind == "pose":
            return pose_at(kept, time_s)
        if not times:
            return None
        nearest = min(range(len(times)), key=lambda row: abs(times[row] - time_s))
        return kept[nearest][1] if abs(times[nearest] - time_s) <= MAX_APART_S else None


def pose_at(poses: list[tuple[float, np.ndarray]], time_s: float) -> np.ndarray | None:
    """Return the pose (4, 4) at a time between two of a list in order of time; None outside, or in a large gap."""
    after = bisect_left(poses, time_s, key=lambda item: item[0])
    if after == len(poses):
        return None
    (later, b), (earlier, a) = poses[after], poses[max(after - 1, 0)]
    if later == time_s:
        return b
    if after == 0 or later - earlier > MAX_GAP_S:
        return None
    share, pose = (time_s - earlier) / (later - earlier), np.eye(4)
    pose[:3, :3] = Slerp((0, 1), Rotation.from_matrix([a[:3, :3], b[:3, :3]]))(share).as_matrix()
    pose[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return pose
