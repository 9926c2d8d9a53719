"""What two views share, against planes whose overlap is known by heart."""

import numpy as np
import pytest

from emgs_jax.data.base import Frame
from emgs_jax.prior.simulated.truth import shared_points

WIDTH, HEIGHT = 80, 60
INTRINSICS = (40.0, 40.0, 39.5, 29.5)  # at 2 m the image is 4 m wide


def view(depth, x=0.0, z=0.0, yaw=0.0):
    """A camera at (x, 0, z) that looks along +z, turned about y; `depth` is a number or an image."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[:3, 3] = x, 0, z
    depth = np.broadcast_to(np.asarray(depth, np.float32), (HEIGHT, WIDTH)).copy()
    return Frame(0, 0.0, "", np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, T)


def share(a, b, num_columns=80):
    assert shared_points(a, b, INTRINSICS, 0.05, num_columns) == shared_points(b, a, INTRINSICS, 0.05, num_columns)
    return shared_points(a, b, INTRINSICS, 0.05, num_columns)


@pytest.mark.parametrize("num_columns", [80, 40])
def test_views_of_a_wall_share_the_width_that_they_overlap_by_and_a_detail_all_of_itself(num_columns):
    for shift, expected in ((0.0, 1.0), (1.0, 0.75), (3.0, 0.25), (3.9, 0.025), (4.1, 0.0)):
        found = share(view(2.0), view(2.0, x=shift), num_columns)
        assert found == pytest.approx(expected, abs=1 / num_columns)
    # From a quarter of the distance it sees a sixteenth of the other's points: the larger of the two counts.
    assert share(view(2.0), view(0.5, z=1.5), num_columns) == 1.0


def test_nothing_is_shared_with_what_is_behind_the_camera_or_a_wall():
    for depth in (1.0, 2.0):
        assert share(view(depth), view(depth, yaw=np.pi)) == 0.0
    assert share(view(2.0), view(1.0)) == 0.0, "the same directions, but the other view ends at a nearer surface"
    assert share(view(2.0), view(2.0 * 1.04)) == 1.0
    assert share(view(2.0), view(2.0 * 1.06)) == 0.0


def test_a_pixel_without_depth_is_no_point_and_meets_none():
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, : WIDTH // 2] = 0
    assert share(view(depth), view(depth)) == 1.0
    depth[:, : WIDTH // 4], depth[:, WIDTH // 4 : WIDTH // 2] = np.nan, np.inf
    assert share(view(depth), view(depth)) == 1.0
    depth[:] = 0
    assert share(view(depth), view(2.0)) == 0.0
