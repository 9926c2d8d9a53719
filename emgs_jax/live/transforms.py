"""Where the frames of a robot are: fixed transforms, and moving ones that are interpolated between their messages."""

from bisect import bisect_left
from collections.abc import Iterator
from typing import Any

import numpy as np

from emgs_jax.data.reading import rigid
from emgs_jax.live.joined_messages import BACK_S, KEPT_S, pose_at


class Transforms:
    """Frames as a tree: each has a parent, and its pose there, which is fixed or moves.

    Attributes:
        problem: why the last transform that was left out could not be used; None if there was none.
    """

    def __init__(self) -> None:
        self._fixed: dict[str, tuple[str, np.ndarray]] = {}  # parent, and T_parent_frame
        self._moving: dict[str, tuple[str, list[tuple[float, np.ndarray]]]] = {}  # likewise, in order of time
        self.problem: str | None = None

    def _read(self, message: Any) -> Iterator[tuple[str, str, float, np.ndarray]]:
        """Yield child, parent, time and T_parent_child of each transform; one that is not rigid is left out."""
        for one in message.transforms:
            child, parent = bare(one.child_frame_id), bare(one.header.frame_id)
            try:
                yield child, parent, stamp_of(one), transform_of(one)
            except ValueError as error:
                self.problem = f"the transform from {parent} to {child} is left out: {error}"

    def add_fixed(self, message: Any) -> None:
        """Take the transforms of a TFMessage on /tf_static."""
        for child, parent, _, T_parent_child in self._read(message):
            self._fixed[child] = parent, T_parent_child

    def add_moving(self, message: Any, below: str, above: str) -> bool:
        """Take the transforms of a TFMessage on /tf; return whether one is on the way from a frame up to another.

        A time that lies far before the last one begins anew, as a bag that is played again.
        """
        is_on_way = False
        for child, parent, time_s, T_parent_child in self._read(message):
            known, poses = self._moving.get(child, (parent, []))
            if known != parent or (poses and time_s < poses[-1][0] - BACK_S):
                poses = []
            poses.insert(bisect_left(poses, time_s, key=lambda item: item[0]), (time_s, T_parent_child))
            while poses[-1][0] - poses[0][0] > KEPT_S:
                del poses[0]
            self._moving[child] = parent, poses
            is_on_way |= child in self.way(below, above)
        return is_on_way

    def pose(self, below: str, above: str, time_s: float) -> np.ndarray | None:
        """Return T_above_below (4, 4) at a time; None if `above` is not above it, or that is not known for the time."""
        way, pose = self.way(below, above), np.eye(4)
        if below != above and not way:
            return None
        for name in way:
            step = self._fixed[name][1] if name in self._fixed else pose_at(self._moving[name][1], time_s)
            if step is None:
                return None
            pose = step @ pose
        return pose

    def root(self, name: str) -> tuple[str, np.ndarray]:
        """Return the last frame above one by fixed transforms, and the pose of the latter in it."""
        pose = np.eye(4)
        for _ in range(len(self._fixed)):
            if name not in self._fixed:
                break
            name, step = self._fixed[name]
            pose = step @ pose
        return name, pose

    def way(self, below: str, above: str) -> list[str]:
        """List the frames from one up to another, without the latter; empty if it is not above."""
        way, name = [], below
        for _ in range(len(self._fixed) + len(self._moving)):
            if name == above:
                break
            found = self._fixed.get(name) or self._moving.get(name)
            if found is None:
                break
            way.append(name)
            name = found[0]
        return way if name == above else []


def bare(name: str) -> str:
    """Return the name of a frame without the slash of ROS 1."""
    return name.lstrip("/")


def stamp_of(message: Any) -> float:
    """Seconds of a message's header."""
    return message.header.stamp.sec + message.header.stamp.nanosec / 1e9


def transform_of(message: Any) -> np.ndarray:
    """T_parent_child (4, 4) of a TransformStamped."""
    place, turn = message.transform.translation, message.transform.rotation
    return rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
