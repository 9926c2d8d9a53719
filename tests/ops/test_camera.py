"""The pinhole against OpenCV, literal pixels, and its own inverse."""

import cv2
import jax
import numpy as np
import pytest
from scene import on_host

from emgs_jax.ops import camera as pinhole
from emgs_jax.ops.camera import Camera, downscale

nearest_pixel, pixel_grid, project, rays, unproject = (
    on_host(f) for f in (pinhole.nearest_pixel, pinhole.pixel_grid, pinhole.project, pinhole.rays, pinhole.unproject)
)
RNG = np.random.default_rng(0)
POINTS = RNG.uniform([-2, -2, 0.5], [2, 2, 6], (200, 3)).astype(np.float32)


def test_projection_equals_opencv(camera):
    (fx, fy), (cx, cy) = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(POINTS.astype(float), np.zeros(3), np.zeros(3), matrix, None)
    pixels, depth = project(camera, POINTS)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-4)  # pixels; float32 at coordinates of about 100
    np.testing.assert_array_equal(depth, POINTS[:, 2])


def test_a_literal_point_has_its_literal_pixel():
    camera = Camera([100, 200], [10, 20], 64, 48)
    pixels, depth = project(camera, np.float32([0.5, -0.25, 2.0]))
    np.testing.assert_array_equal(pixels, [35.0, -5.0])  # x right, y down, centres at integers
    assert depth == 2
    np.testing.assert_array_equal(rays(camera, np.float32([35.0, -5.0])), [0.25, -0.125, 1.0])


def test_the_pixel_grid_is_row_major_x_first(camera):
    grid = pixel_grid(camera)
    assert grid.shape == (24, 32, 2)
    np.testing.assert_array_equal(grid[5, 7], [7, 5])


def test_unprojecting_and_projecting_gives_the_pixel_back(camera):
    depth = np.float32(RNG.uniform(0.5, 5, (24, 32)))
    points = unproject(camera, depth)
    pixels, z = project(camera, points)
    np.testing.assert_allclose(pixels, pixel_grid(camera), atol=1e-4)  # pixels; float32 roundings
    np.testing.assert_array_equal(z, depth)
    np.testing.assert_array_equal(unproject(camera, np.zeros((24, 32), np.float32)), np.zeros((24, 32, 3)))


@pytest.mark.parametrize("z", [0.0, -1.0, 1e-7])
def test_a_point_that_is_not_in_front_projects_as_from_one_metre_with_its_own_depth(camera, z):
    pixels, depth = project(camera, np.float32([0.1, -0.2, z]))
    np.testing.assert_allclose(pixels, [20 * 0.1 + 14.5, -23 * 0.2 + 12.25], rtol=1e-6)
    assert depth == np.float32(z)
    slopes = on_host(jax.jacfwd(lambda p: pinhole.project(camera, p)[0]))
    assert np.isfinite(slopes(np.float32([0.1, -0.2, z]))).all()


def test_a_point_two_millimetres_in_front_of_the_camera_still_has_its_own_pixel(camera):
    pixels, _ = project(camera, np.float32([0.0002, -0.0004, 0.002]))
    np.testing.assert_allclose(pixels, [20 * 0.1 + 14.5, -23 * 0.2 + 12.25], rtol=1e-5)  # a few roundings


def test_the_nearest_pixel_is_numbered_row_by_row_and_a_pixel_reaches_half_way_to_the_next():
    pixels = [(0.4, 0.3), (2.6, 1.4), (2.4, 1.6), (3.4, 2.4), (-0.4, -0.4)]
    rows, inside = nearest_pixel(np.float32(pixels), (3, 4))
    np.testing.assert_array_equal(rows, [0, 7, 10, 11, 0])
    assert inside.all()
    beyond = [(-0.6, 0.0), (0.0, -0.6), (3.6, 1.0), (1.0, 2.6), (3.0, 3.0)]  # one side each; the last is (4, 3) turned
    rows, inside = nearest_pixel(np.float32(beyond), (3, 4))
    np.testing.assert_array_equal(rows, 0)
    assert not inside.any()


@pytest.mark.parametrize("stride", [1, 2, 3, 5])
def test_a_downscaled_camera_sees_every_stride_th_pixel(camera, stride):
    small = downscale(camera, stride)
    every = rays(camera, pixel_grid(camera))[::stride, ::stride]
    assert (small.height, small.width) == every.shape[:2]
    np.testing.assert_allclose(rays(small, pixel_grid(small)), every, atol=1e-6)  # float32 roundings near 1


def test_projection_passes_strict_promotion(camera):
    with jax.numpy_dtype_promotion("strict"):
        unproject(downscale(camera, 2), project(camera, POINTS)[1][:192].reshape(12, 16))
