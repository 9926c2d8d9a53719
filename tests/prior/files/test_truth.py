"""A wrong `depth_scale` or convention; oracle: the plane of the written scene, seen from a camera that moves."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.prior.files.truth import check_truth
from tests.data.written_scene import plane_depth, scene_pose

INTRINSICS, SIZE = (60.0, 60.0, 31.5, 23.5), (64, 48)


class Planes:
    """Depths of so many raw units a metre that are read as if they were of `depth_scale`."""

    name, sequence, size, intrinsics, has_ground_truth = "planes", "one", SIZE, INTRINSICS, True

    def __init__(self, raw: float, depth_scale: float, broken: int | None = None, said: Callable = np.array) -> None:
        self.factor, self.broken, self.said = raw / depth_scale, broken, said

    def __len__(self) -> int:
        return 9

    def __getitem__(self, row: int) -> Frame:
        if row == self.broken:
            raise BadFrameError("damaged")
        depth = self.factor * plane_depth(scene_pose(row), INTRINSICS, SIZE)
        return Frame(row, row, str(row), np.zeros((*depth.shape, 3), np.uint8), depth, self.said(scene_pose(row)))


@pytest.mark.parametrize(("raw", "depth_scale"), [(1000.0, 5000.0), (5000.0, 1000.0), (1000.0, 1.0), (256.0, 5000.0)])
def test_depths_of_another_scale_are_refused_with_the_right_one(raw, depth_scale):
    """A RealSense's millimetres in TUM's layout came five times too near, without a word."""
    with pytest.raises(ValueError, match=rf"planes one: .* give dataset\.depth_scale={raw:g}, or poses in metres"):
        check_truth(Planes(raw, depth_scale), depth_scale)


def test_what_fits_or_cannot_be_told_is_accepted():
    for scale in (1000.0, 5000.0, 4720.1, 6553.5):
        check_truth(Planes(scale, scale), scale)
    check_truth(Planes(1000.0, 1000.0, broken=0), 1000.0)
    check_truth(SimpleNamespace(has_ground_truth=False), 1000.0)


@pytest.mark.parametrize("depth_scale", [1000.0, None])
def test_true_poses_of_another_convention_are_refused(depth_scale):
    """COLMAP's world -> camera in a list of TUM's layout became a truth that every score was taken against."""
    with pytest.raises(ValueError, match="planes one, true poses and depths: .* taken as world -> camera:"):
        check_truth(Planes(1000.0, 1000.0, said=np.linalg.inv), depth_scale)
