"""The first map: its number of Gaussians, its weights, its place in the world, and independence of the world frame."""

import jaxlie
import numpy as np
import pytest
import reference
import scene as sc

from emgs_jax.initialization import initialize, merge

first_map = sc.on_host(initialize)
POSES = [sc.path_pose(i) for i in range(3)]


@pytest.fixture(scope="module")
def views(camera):
    return sc.stack([sc.observe_room(T, camera, num_features=2) for T in POSES])


@pytest.fixture(scope="module")
def result(views, camera, config):
    return first_map(views, sc.stack_poses(POSES), camera, 1, config().fit)


def test_there_are_num_points_over_lambda_and_views_gaussians(result):
    gaussians, weight, _ = result
    assert gaussians.valid.shape == (3 * 768 // (8 * 3),) == weight.shape
    assert gaussians.valid.all()


def test_the_weights_count_every_point_in_units_of_lambda(result):
    np.testing.assert_allclose(result[1].sum(), 3 * 768 / 8, rtol=1e-5)  # float32 sums


def test_an_even_choice_of_the_merged_points_is_even_over_every_view(views, camera):
    """Of its twelve blocks of 8 by 8 pixels each has 64 / 24 of every 24th point: two or three."""
    _, _, order = merge(views, sc.stack_poses(POSES), camera)
    view, pixel = np.divmod(np.asarray(order)[::24], 768)
    y, x = np.divmod(pixel, camera.width)
    counts = np.zeros((3, 3, 4), int)
    np.add.at(counts, (view, y // 8, x // 8), 1)
    assert counts.min() == 2 and counts.max() == 3


def test_the_views_are_moved_to_the_world_by_the_priors_poses(result, views):
    for i, T in enumerate(POSES):
        expected = sc.moved_points(T, sc.rows_of(views, i))
        np.testing.assert_allclose(result[2].points[i], expected.points, atol=1e-6)  # roundings


@pytest.mark.parametrize("nowhere", [np.nan, 0.0])
def test_a_view_without_a_pose_has_no_point_and_the_others_make_the_map(views, camera, config, nowhere):
    poses = np.array(sc.stack_poses(POSES).wxyz_xyz)
    poses[1] = nowhere
    gaussians, weight, world = first_map(views, jaxlie.SE3(sc.device(poses)), camera, 1, config().fit)
    assert world.valid.any(axis=1).tolist() == [True, False, True]
    assert np.isfinite(gaussians.means).all()
    np.testing.assert_allclose(weight.sum(), 2 * 768 / 8, rtol=1e-5)


def test_the_gaussians_lie_on_the_rooms_walls_with_their_normals_and_colours(result):
    g = result[0]
    means = np.asarray(g.means, float)
    distance = np.concatenate([np.abs(means - reference.ROOM_LOW), np.abs(means - reference.ROOM_HIGH)], axis=1)
    on_wall = distance.min(1) < 1e-3  # the others are clusters across an edge
    assert on_wall.mean() > 0.5
    inward = np.concatenate([np.eye(3), -np.eye(3)])[distance.argmin(1)]
    cos = np.sum(np.asarray(g.normals) * inward, axis=1)
    assert np.median(cos[on_wall]) > 0.999
    # A mean over some 20 cm of a texture that changes by .9 a metre at most
    assert np.abs(np.asarray(g.colors) - reference.texture(means))[on_wall].max() < 0.1


def test_invalid_points_are_not_clustered(views, camera, config):
    blind = sc.replace(views, valid=views.valid & (np.arange(3) < 1)[:, None])
    gaussians, weight, _ = first_map(blind, sc.stack_poses(POSES), camera, 1, config().fit)
    np.testing.assert_allclose(weight.sum(), 768 / 8, rtol=1e-5)
    nothing = sc.replace(views, valid=np.zeros((3, 768), bool))
    gaussians, weight, _ = first_map(nothing, sc.stack_poses(POSES), camera, 1, config().fit)
    assert not gaussians.valid.any() and weight.sum() == 0


@pytest.mark.slow
def test_features_of_width_zero_are_possible(camera, config, result):
    views = sc.stack([sc.observe_room(T, camera) for T in POSES])
    gaussians, _, _ = first_map(views, sc.stack_poses(POSES), camera, 1, config().fit)
    # Another program, whose sums may round otherwise; as above.
    error = np.abs(gaussians.means - result[0].means).max(1)
    assert np.median(error) < 1e-5 and error.max() < 0.05
