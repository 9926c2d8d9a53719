"""A length between two pixels."""

import numpy as np
import pytest

from emgs_jax.scale.tape import pixel_in, point_at, scale_of_distance, spread_of

FOCAL = 300.0
FOCALS = np.array([FOCAL, 200.0])


def test_a_distance_across_the_view_gives_its_scale():
    points = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
    scale = scale_of_distance(points, np.array([0.01, 0.01]), FOCAL, 2.5, "distance")
    assert scale.factor == pytest.approx(2.5)
    beside = (2 * (2.0 / FOCAL) ** 2) ** 0.5
    assert scale.std == pytest.approx((0.01**2 + beside**2) ** 0.5)  # an error that both share


def test_a_distance_along_the_view_errs_by_both_depths():
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    scale = scale_of_distance(points, np.array([0.01, 0.02]), 1e9, 1.0, "distance")
    assert scale.std == pytest.approx((0.02**2 + 0.06**2) ** 0.5)


def test_its_standard_deviation_is_right():
    """Points that err along their rays by what they say, beside a pixel."""
    rng, truth = np.random.default_rng(0), np.array([[-0.8, 0.3, 2.0], [0.6, -0.2, 3.5]])
    metres, off = np.linalg.norm(truth[1] - truth[0]), []
    for _ in range(2000):
        points = truth * np.exp(0.03 * rng.normal(size=(2, 1)))
        points[:, :2] += points[:, 2:] / FOCAL * rng.normal(size=(2, 2))
        scale = scale_of_distance(points, np.array([0.03, 0.03]), FOCAL, metres, "distance")
        off.append(scale.log / scale.std)
    assert 0.7 < np.std(off) < 1.1


def test_the_point_at_a_pixel_is_the_median_near_it():
    depth = np.full((20, 30), 2.0)
    depth[10, 15] = 9.0  # a wrong one
    points = np.stack([0 * depth, 0 * depth, depth], axis=-1)
    point, std = point_at(points, np.full((20, 30), 0.01), np.array([15.0, 10.0]), FOCALS)
    assert point[2] == pytest.approx(2.0) and std == pytest.approx(0.01)


def test_the_point_is_on_the_ray_of_the_pixel_itself():
    """Symptom: it was on that of the neighbour with the median depth, and 40 pixels were 5 % too many or too few."""
    rng, pixel = np.random.default_rng(0), np.array([15.4, 9.7])
    rows, columns = np.indices((20, 30))
    rays = np.stack([(columns - 14.5) / FOCALS[0], (rows - 9.5) / FOCALS[1], np.ones((20, 30))], axis=-1)
    points = 2.0 * np.exp(0.005 * rng.normal(size=(20, 30, 1))) * rays
    points[10, 14:16] = 0.0
    point, _ = point_at(points, np.full((20, 30), 0.01), pixel, FOCALS)
    assert point[:2] / point[2] == pytest.approx((pixel - [14.5, 9.5]) / FOCALS)
    assert point[2] == pytest.approx(2.0, rel=0.005)


def test_one_point_twice_has_no_scale():
    """Symptom: "float division by zero"."""
    with pytest.raises(ValueError, match="distance in a.jpg show one point: choose points far apart"):
        scale_of_distance(np.ones((2, 3)), np.array([0.01, 0.01]), FOCAL, 1.0, "distance in a.jpg")


def test_an_edge_is_less_sure():
    depth = np.full((20, 30), 2.0)
    depth[:, 16:] = 4.0
    points = np.stack([0 * depth, 0 * depth, depth], axis=-1)
    near = point_at(points, np.full((20, 30), 0.01), np.array([15.0, 10.0]), FOCALS)
    far = point_at(points, np.full((20, 30), 0.01), np.array([10.0, 10.0]), FOCALS)
    depth[9:12, 14:18] = np.linspace(2, 4, 12).reshape(3, 4)
    points[..., 2] = depth
    mixed = point_at(points, np.full((20, 30), 0.01), np.array([16.0, 10.0]), FOCALS)
    assert far[1] == pytest.approx(0.01) and near[0][2] == 2.0 and mixed[1] > 0.05


def test_no_depth_near_a_pixel_is_no_point():
    assert point_at(np.zeros((20, 30, 3)), np.ones((20, 30)), np.array([3.0, 3.0]), FOCALS) is None


@pytest.mark.parametrize("pixel", [(-9.0, 5.0), (5.0, -9.0), (30.0, 5.0), (5.0, 20.0)])
def test_no_pixel_of_the_frame_is_no_point(pixel):
    """Symptom: far above or left of a frame it was the median of nearly all of it."""
    points = np.full((20, 30, 3), 2.0)
    assert point_at(points, np.ones((20, 30)), np.array(pixel), FOCALS) is None
    assert point_at(points, np.ones((20, 30)), np.array([-0.25, 19.4]), FOCALS) is not None


def test_a_point_is_seen_where_the_camera_looks():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1.0, 0.0, 0.5]  # looks along the world's x
    pixel, depth = pixel_in(np.array([3.0, -0.4, 0.1]), T, (100.0, 200.0, 50.0, 40.0))
    assert pixel == pytest.approx([100 * 0.4 / 2 + 50, 200 * 0.4 / 2 + 40]) and depth == 2.0
    behind = pixel_in(np.array([0.0, 0.0, 0.5]), T, (100.0, 200.0, 50.0, 40.0))
    assert behind[1] == -1.0 and np.isnan(behind[0]).all()


def test_frames_that_disagree_make_a_depth_less_sure():
    """Symptom: one distance in ten was 18 % off, at ends whose depth was said to be right to 2 %."""
    agreed = spread_of([2.0, 2.0, 1.0], [2.02, 1.99, 0.4])
    assert agreed == pytest.approx(1.4826 * np.log(1.01)), "one behind another surface does not count"
    assert spread_of([2.0, 2.0, 2.0], [3.0, 1.5, 2.9]) > 0.4 and spread_of([], []) == 0.0
