"""Join the messages of one moment: an image, its depth, and the pose between two messages of odometry."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

MAX_APART_S = 0.02  # from an image to its depth
MAX_GAP_S = 0.5  # between two poses between which one is interpolated
KEPT_S = 3.0  # messages of each kind; an image that nothing fits is left out by then
BACK_S = 1.0  # a stamp so far before the newest of its kind begins anew: a bag that is played again


Find = Callable[[list[tuple[float, Any]], float], Any | None]  # in messages, by order of time, what is of a time


class Joined:
    """Images that wait for what belongs to them.

    Args:
        kinds: what an image needs beside it: "depth" and "pose", one of them, or none.
        find: how it is found where not by `FIND`, by kind.

    Attributes:
        num_alone: images that were left out because something did not come.
    """

    def __init__(self, kinds: set[str], find: Mapping[str, Find] = {}) -> None:
        self._kinds, self.num_alone, self._find = kinds, 0, {**FIND, **find}
        self._waiting: dict[str, list[tuple[float, Any]]] = {kind: [] for kind in ("image", *kinds)}

    def add(self, kind: str, time_s: float, value: Any) -> Iterator[tuple[float, dict[str, Any]]]:
        """Add a message of an "image", a "depth" or a "pose" (4, 4); yield what is whole, in order of time."""
        kept = self._waiting[kind]
        if kept and time_s < kept[-1][0] - BACK_S:
            for messages in self._waiting.values():
                messages.clear()
        kept.insert(bisect_left(kept, time_s, key=lambda item: item[0]), (time_s, value))
        while kept[-1][0] - kept[0][0] > KEPT_S:
            self.num_alone += kind == "image"
            del kept[0]
        yield from self.whole()

    def whole(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yield the images that are whole by now, in order of time; earlier ones are left out."""
        images = self._waiting["image"]
        for place, (image_time, image) in enumerate(images):
            found = self._found(image_time)
            if found is not None:
                self.num_alone += place  # later ones are whole, so these will not be
                del images[: place + 1]
                yield image_time, {"image": image, **found}
                yield from self._rest()
                return

    def _rest(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yield later images that are whole, too."""
        images = self._waiting["image"]
        while images and (found := self._found(images[0][0])) is not None:
            time_s, image = images.pop(0)
            yield time_s, {"image": image, **found}

    def _found(self, time_s: float) -> dict[str, Any] | None:
        """What belongs to an image of this time; None if something has not come yet."""
        found = {}
        for kind in sorted(self._kinds):  # a pose between two takes long, and odometry comes often
            value = self._find[kind](self._waiting[kind], time_s)
            if value is None:
                return None
            found[kind] = value
        return found


def nearest(kept: list[tuple[float, Any]], time_s: float) -> Any | None:
    """Return the message nearest in time, once one is there that is not earlier; None if it is too far away."""
    if not kept or kept[-1][0] < time_s:
        return None
    at, value = min(kept, key=lambda item: abs(item[0] - time_s))
    return value if abs(at - time_s) <= MAX_APART_S else None


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


FIND: dict[str, Find] = {"depth": nearest, "pose": pose_at}
