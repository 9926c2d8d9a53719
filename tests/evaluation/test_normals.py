"""Oracles: normals of planes, spheres and steps in closed form, poison."""

import numpy as np
import pytest
from cloud_scene import INTRINSICS, SHAPE, plane_depth
from scene import evaluation_config

from emgs_jax.data.backprojection import backproject
from emgs_jax.evaluation.reconstruction import window_normals

CONFIG = evaluation_config()


def known_normals(depth, valid):
    normals = window_normals(backproject(np.where(valid, depth, 0.0), INTRINSICS), valid, CONFIG)
    return normals, normals.any(-1)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.3, 0.8), (-0.6, 0.5, 0.62)])
def test_normals_of_a_plane_are_exact_and_face_the_camera_and_a_depth_step_does_not_bend_them(normal):
    normal = np.asarray(normal) / np.linalg.norm(normal)
    depth = plane_depth(normal, 2.0)
    for far in (1.0, 1.5):
        depth[:, 60:] *= far  # the same direction, as seen from the camera
        valid = (depth > 0.3) & (depth < 8.0)
        normals, known = known_normals(depth, valid)
        assert known[valid].mean() > 0.9
        np.testing.assert_allclose(normals[known], np.broadcast_to(-normal, normals[known].shape), atol=2e-3)


def test_normals_of_a_noisy_sphere_point_from_its_centre():
    rays = backproject(np.ones(SHAPE), INTRINSICS)
    center = np.array([0.1, -0.05, 2.5])
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - 1.0
    hit = b * b - a * c > 0
    depth = np.where(hit, (b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a, 0.0)
    noise = 1.0 + 0.002 * np.random.default_rng(5).normal(size=SHAPE)
    normals = window_normals(backproject(depth * noise, INTRINSICS), hit, CONFIG)
    truth = backproject(depth, INTRINSICS) - center
    known = normals.any(-1)
    assert not known[~hit].any()
    assert known[hit].mean() > 0.9
    angles = np.degrees(np.arccos(np.einsum("nk,nk->n", normals[known], truth[known]).clip(-1, 1)))
    assert np.median(angles) < 4.0


def test_invalid_pixels_have_no_normal_and_change_no_other():
    depth = plane_depth((0.3, 0.2, 0.9), 2.0)
    points, valid = backproject(depth, INTRINSICS), np.ones(SHAPE, bool)
    valid[20:30, 40:55] = False
    poisoned = points.copy()
    poisoned[~valid] = np.nan
    normals = window_normals(poisoned, valid, CONFIG)
    assert not normals[~valid].any()
    points[~valid] = 0.0
    np.testing.assert_array_equal(normals, window_normals(points, valid, CONFIG))


def test_pixels_that_stand_out_of_a_plane_a_little_do_not_bend_the_normals_around_them():
    """One in twenty is nearer by more than the second pass takes, by less than the first: the first plane is bent."""
    depth = plane_depth((0.3, 0.2, 0.9), 2.0)
    stands_out = np.random.default_rng(1).uniform(size=SHAPE) < 0.05
    share = 0.5 * (CONFIG.max_normal_residual + CONFIG.max_normal_gap)
    assert CONFIG.max_normal_residual < 0.7 * share
    normals = window_normals(
        backproject(np.where(stands_out, depth / (1 + share), depth), INTRINSICS), depth > 0, CONFIG
    )
    known = normals.any(-1) & ~stands_out
    assert known[~stands_out].mean() > 0.95
    cosines = normals[known] @ -np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
    angles = np.degrees(np.arccos(cosines.clip(-1, 1)))
    assert np.quantile(angles, 0.9) < 1.0
