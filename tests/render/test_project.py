"""EWA projection against NumPy, sampled Gaussians, and the exact depth of planes."""

import jax
import numpy as np
import pytest
import reference
from scene import as_numpy, matrix_of, on_host, pose, random_gaussians, replace

from emgs_jax.ops.camera import pixel_grid
from emgs_jax.render.project import project_gaussians

project = on_host(project_gaussians)
T = pose((0.1, -0.2, 0.05), (0.1, -0.05, 0.2))
COUNT = 30  # Gaussians of every scene
SCALE, BLUR = np.float32(2.0), np.float32(0.3)
GAUSSIANS = random_gaussians(COUNT, 1, low=(-0.7, -0.5, 1.5), high=(0.7, 0.5, 3))


def all_with(**rows):
    """The Gaussians, with one row for all of some fields."""
    return replace(GAUSSIANS, **{name: np.tile(row, (COUNT, *[1] * np.ndim(row))) for name, row in rows.items()})


def tilted(cosine):
    """Gaussians off the axis, whose normals have this cosine with the ray to them."""
    ray = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    across = np.cross(ray, [0, 1, 0]) / np.linalg.norm(np.cross(ray, [0, 1, 0]))
    return all_with(means=2.5 * ray, normals=cosine * ray + np.sqrt(1 - cosine**2) * across)


def test_splats_equal_the_local_affine_approximation(camera):
    splats, g = project(GAUSSIANS, T, camera, SCALE, BLUR), as_numpy(GAUSSIANS)
    matrix = matrix_of(T)
    for k in range(COUNT):
        pixel, cov_2d, point, cov = reference.splat(g["means"][k], g["covs"][k], matrix, camera, 2.0, 0.3)
        np.testing.assert_allclose(splats.means[k], pixel, atol=1e-4)  # pixels; coordinates of about 30
        np.testing.assert_allclose(splats.covs[k], cov_2d, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(splats.precisions[k], np.linalg.inv(cov_2d), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose([splats.depth[k], splats.inverse_depth[k]], [point[2], 1 / point[2]], rtol=1e-5)
        np.testing.assert_allclose(splats.depth_std[k], np.sqrt(cov[2, 2]), rtol=1e-4)
    assert splats.valid.all()


def test_the_inverse_depth_of_a_slanted_plane_is_exact_at_every_pixel(camera):
    splats, g = project(GAUSSIANS, T, camera, SCALE, BLUR), as_numpy(GAUSSIANS)
    matrix, pixels = matrix_of(T), np.asarray(pixel_grid(camera), float)
    on_plane = (pixels - np.asarray(camera.center)) / np.asarray(camera.focal)
    directions = np.concatenate([on_plane, np.ones((24, 32, 1))], axis=-1)
    for k in range(COUNT):
        normal, point = matrix[:3, :3].T @ g["normals"][k], matrix[:3, :3].T @ (g["means"][k] - matrix[:3, 3])
        expected = directions @ normal / (normal @ point)
        actual = float(splats.inverse_depth[k]) + (pixels - splats.means[k]) @ splats.depth_slope[k]
        np.testing.assert_allclose(actual, expected, atol=2e-5)  # 1/m; slopes of .1 over 30 pixels in float32


@pytest.mark.parametrize("mean", [(-9, 0.1, 2), (9, 0.2, 2), (0.1, -8, 2), (0, 8, 2), (1.3, 0.2, 2), (0.1, -0.9, 2)])
def test_far_outside_the_image_the_jacobian_is_that_of_its_margin(camera, mean):
    """30 % of the image's size beyond its border; the last two are outside, but nearer than that."""
    far = all_with(means=np.array(mean, float))
    splats, g = project(far, pose(), camera, SCALE, BLUR), as_numpy(far)
    for k in range(3):
        _, cov_2d, *_ = reference.splat(g["means"][k], g["covs"][k], np.eye(4), camera, 2.0, 0.3)
        np.testing.assert_allclose(splats.covs[k], cov_2d, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("cosine", "has_slope"), [(0.09, False), (-0.09, False), (0.11, True), (-0.11, True)])
def test_a_gaussian_has_a_depth_slope_from_a_cosine_of_a_tenth_on(camera, cosine, has_slope):
    """Of the angle between its normal and the ray to it, wherever in the image it is."""
    splats = project(tilted(cosine), pose(), camera, SCALE, BLUR)
    assert (splats.depth_slope != 0).any() == has_slope


@pytest.mark.parametrize("z", [-1.0, 0.0, 5e-4])
def test_a_gaussian_that_is_not_in_front_is_invalid_and_finite(camera, z):
    splats = project(all_with(means=[0.3, -0.2, z]), pose(), camera, SCALE, BLUR)
    assert not splats.valid.any()
    np.testing.assert_allclose(splats.depth, z if z > 0 else 1.0, rtol=1e-6)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(splats))


@pytest.mark.parametrize(("ratio", "is_drawn"), [(1.9, False), (2.1, True)])
def test_what_reaches_the_plane_of_the_camera_is_not_drawn(camera, ratio, is_drawn):
    """Of depths of 1.9 and 2.1 of its standard deviations, which the scale of the covariances counts in."""
    near = all_with(means=[0.1, 0, 0.5], covs=np.diag([1e-4, 1e-4, (0.5 / ratio) ** 2 / SCALE]))
    np.testing.assert_array_equal(project(near, pose(), camera, SCALE, BLUR).valid, is_drawn)


@pytest.mark.parametrize(("cosine", "is_drawn"), [(-0.9, True), (0.09, True), (0.11, False), (0.9, False)])
def test_a_gaussian_is_not_seen_from_behind(camera, cosine, is_drawn):
    """A cosine of a tenth, of the angle between the ray to it and its normal, may be the error of a grazing look."""
    np.testing.assert_array_equal(project(tilted(cosine), pose(), camera, SCALE, BLUR).valid, is_drawn)
