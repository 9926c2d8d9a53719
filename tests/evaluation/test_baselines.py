"""Voxel averaging and TSDF of exact planes; oracles: the planes, means per voxel, similarities that are known."""

import numpy as np
import pytest
from scene import compose, evaluation_config
from scipy.spatial.transform import Rotation

from emgs_jax.config.configure import baseline_configs
from emgs_jax.data.backprojection import backproject
from emgs_jax.evaluation.baselines import Pinhole, TsdfConfig, View, VoxelConfig, _Blocks, draw_voxels
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds, transform_cloud
from emgs_jax.evaluation.reconstruction import camera_cloud
from emgs_jax.geometry import Sim3

PINHOLE = Pinhole((60.0, 55.0, 31.0, 25.5), 64, 48)
VOXEL, TSDF = VoxelConfig(0.02, 8, 0.1, 1), TsdfConfig(0.02, 0.08, 1)
BOTH = pytest.mark.parametrize("config", [VOXEL, TSDF], ids=["voxel", "tsdf"])


DISTANCE = 2.01  # the middle of a voxel


def plane(normal=(0.0, 0.0, 1.0), distance=DISTANCE, T=None):
    """Camera-space depth of normal · p = distance of the world, seen from a pose."""
    rays = backproject(np.ones((PINHOLE.height, PINHOLE.width)), PINHOLE.intrinsics)
    T = np.eye(4) if T is None else T
    normal = np.asarray(normal) / np.linalg.norm(normal)
    return (distance - normal @ T[:3, 3]) / (rays @ T[:3, :3].T @ normal)


def a_view(depth, color=(51, 102, 204)):
    image = np.empty((*depth.shape, 3), np.uint8)
    image[...] = color
    points = backproject(depth, PINHOLE.intrinsics)
    return View(depth.astype(np.float32), image, camera_cloud(points, depth > 0, image, evaluation_config()))


def fused(config, *views):
    """Of (view, pose, scale)."""
    fusion = config.start(PINHOLE, 1.0)
    for view in views:
        fusion.add(*view)
    return fusion


@BOTH
def test_an_exact_plane_gives_its_points_its_normal_and_its_colour(config):
    cloud = fused(config, (a_view(plane()), np.eye(4), 1.0), (a_view(plane()), np.eye(4), 1.0)).cloud()
    assert len(cloud) > 1000
    np.testing.assert_allclose(cloud.points[:, 2], DISTANCE, atol=1e-6)  # float32
    assert np.ptp(cloud.points[:, 0]) > 2.0 and np.ptp(cloud.points[:, 1]) > 1.5, "the whole view: 2.1 by 1.7 m"
    np.testing.assert_allclose(cloud.colors, np.broadcast_to([0.2, 0.4, 0.8], cloud.colors.shape), atol=1e-6)
    is_known = cloud.normals.any(1)
    assert is_known.mean() > 0.9
    np.testing.assert_allclose(cloud.normals[is_known] @ [0.0, 0.0, -1.0], 1.0, atol=5e-3)  # the border of a field


def test_a_wall_at_a_whole_number_of_voxels_is_found_and_one_seen_less_often_than_asked_for_is_left_out():
    """Open3D's grid finds none there."""
    for distance in (1.5, 2.0):
        cloud = fused(TSDF, (a_view(plane(distance=distance)), np.eye(4), 1.0)).cloud()
        assert len(cloud) > 1000
        np.testing.assert_allclose(cloud.points[:, 2], distance, atol=1e-6)
    often, view = TsdfConfig(0.02, 0.08, 2), (a_view(plane()), np.eye(4), 1.0)
    assert len(fused(often, view).cloud()) == 0 < len(fused(often, view, view).cloud())


@BOTH
def test_a_view_stands_where_its_pose_says_in_the_size_that_its_scale_says(config):
    """A slanted plane seen from two turned cameras, in predictions a quarter too small and twice too large."""
    rng, normal = np.random.default_rng(0), np.array([0.3, -0.2, 0.93])
    views = []
    for scale in (4 / 3, 0.5):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.2).as_matrix()
        T[:3, 3] = rng.normal(size=3) * 0.2
        views.append((a_view(plane(normal, T=T) / scale), T, scale))
    fusion = fused(config, *views)
    distance = fusion.cloud().points @ (normal / np.linalg.norm(normal)) - DISTANCE
    assert abs(distance.mean()) < 5e-4, "no bias: a pixel's shift would tilt the plane by 1 cm"
    assert np.percentile(np.abs(distance), 95) < 0.012  # the TSDF takes the nearest pixel, 1.6 cm of a slope of .3


@BOTH
def test_noise_is_averaged_over_views(config):
    """2 mm, so that no point leaves its voxel: of those that do voxels make two layers."""
    rng = np.random.default_rng(1)
    views = [(a_view(plane() + rng.normal(size=(48, 64)) * 0.002), np.eye(4), 1.0) for _ in range(16)]
    few, many = (fused(config, *views[:count]).cloud().points[:, 2].std() for count in (1, 16))
    assert many < 0.7 * few


@BOTH
def test_what_is_rendered_of_a_plane_is_the_plane_and_its_colour_from_another_pose_too(config):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.03, -0.05, 0.02]).as_matrix(), [0.1, 0.05, 0.4]
    draw = fused(config, (a_view(plane()), np.eye(4), 1.0)).renderer()
    depth, colors = draw(T)
    inner = np.s_[5:-5, 5:-5]  # the closer camera sees no border of the plane
    assert (depth[inner] > 0).all()
    # A point is drawn at its own depth over its footprint, 2 px at most: .06 / 60 of 1.6 m each.
    np.testing.assert_allclose(depth[inner], plane(T=T)[inner], atol=0.01)
    np.testing.assert_allclose(colors[inner], np.broadcast_to([0.2, 0.4, 0.8], colors[inner].shape), atol=1e-5)
    away = np.eye(4)
    away[:3, :3] = np.diag([1.0, -1.0, -1.0])
    assert not draw(away)[0].any(), "behind the camera there is nothing"


@BOTH
def test_half_a_view_covers_half_of_the_image_and_without_a_point_all_is_empty(config):
    depth = plane()
    depth[:, 32:] = 0.0
    found, _ = fused(config, (a_view(depth), np.eye(4), 1.0)).renderer()(np.eye(4))
    assert (found[1:-1, 1:30] > 0).all() and not found[:, 35:].any()
    nothing = a_view(np.zeros((48, 64)))
    for views in ((), ((nothing, np.eye(4), 1.0),)):
        fusion = fused(config, *views)
        assert len(fusion.cloud()) == 0
        depth, colors = fusion.renderer()(np.eye(4))
        assert depth.shape == (48, 64) and not depth.any() and not colors.any()


@BOTH
def test_two_orders_of_threads_give_the_same_rows(config):
    first, second = (fused(config, (a_view(plane((0.1, 0.2, 1.0))), np.eye(4), 1.0)).cloud() for _ in range(2))
    for name in ("points", "normals", "colors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_voxels_are_the_means_of_all_views_so_far():
    views = [(a_view(plane((0.1, 0.2, 1.0))), np.eye(4), scale) for scale in (1.0, 1.2)]
    fusion = fused(VOXEL, views[0])
    for count in (1, 2):
        clouds = [transform_cloud(view.cloud, Sim3(scale, T[:3, :3], T[:3, 3])) for view, T, scale in views[:count]]
        expected = fuse_clouds(clouds, VOXEL.voxel_m)
        np.testing.assert_array_equal(fusion.cloud().points, expected.points)
        fusion.add(*views[1])


def test_the_nearest_point_is_drawn_in_every_pixel_of_its_footprint():
    """At 1 m 2 cm are 1.2 px, so a point reaches one pixel to each side; at 2 m .6 px, one as well."""
    near, far = [0.0, 0.0, 1.0], [1 / 60 * 2, 0.0, 2.0]
    cloud = PointCloud(np.array([near, far]), np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    pinhole = Pinhole((60.0, 60.0, 3.0, 2.0), 8, 5)
    depth, colors = draw_voxels(cloud, np.ones(2), np.eye(4), pinhole, VoxelConfig(0.02, 8, 0.1, 1))
    expected = np.zeros((5, 8))
    expected[1:4, 3:6], expected[1:4, 2:5] = 2.0, 1.0
    np.testing.assert_allclose(depth, expected)
    np.testing.assert_array_equal(colors[..., 0], expected == 1.0)
    wide, _ = draw_voxels(cloud, np.ones(2), np.eye(4), pinhole, VoxelConfig(10.0, 1, 0.1, 1))
    np.testing.assert_allclose(wide, expected, err_msg="farther than the largest footprint")


def test_what_a_camera_cannot_see_is_not_drawn_and_changes_no_pixel():
    """A view of 1,000 frames' cloud cost as much as the cloud."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (20_000, 3))
    cloud, counts = PointCloud(points, np.zeros_like(points), np.abs(points) / 4), rng.integers(1, 9, len(points))
    config, pinhole = VoxelConfig(0.02, 8, 0.1, 4), Pinhole((60.0, 60.0, 31.5, 23.5), 64, 48)
    blocks = _Blocks(cloud, counts, 0.64)
    for turn in ([0, 0, 0], [0.4, 2.0, -1.0], [-1.2, 0.3, 3.0]):
        camera = np.eye(4)
        camera[:3, :3], camera[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), turn
        rows = blocks.before(camera, pinhole, config)
        assert 0 < len(rows) < 0.5 * len(points)
        some = PointCloud(*(values[rows] for values in vars(cloud).values()))
        for own, of_all in zip(
            draw_voxels(some, counts[rows], camera, pinhole, config),
            draw_voxels(cloud, counts, camera, pinhole, config),
            strict=True,
        ):
            np.testing.assert_array_equal(own, of_all)


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((1, 8, 9, 30), 2.1),  # one stray before a surface of two layers, and another surface behind
        ((1, 9, 5, 30), 2.0),
        ((10, 9, 9, 30), 1.0),  # no stray
        ((1, 2, 3, 4), 2.1),  # too few everywhere: most are here
        ((1, 2, 1, 4), 3.0),
    ],
)
def test_a_pixel_shows_the_median_of_the_first_surface_that_is_no_stray(counts, expected):
    """Symptom: the nearest voxel of all frames' noise was drawn, and 7 to 25 % of the depths were within 5 %."""
    points = np.array([[0.0, 0.0, z] for z in (1.0, 2.0, 2.1, 3.0)])
    shuffled = np.array([2, 0, 3, 1])
    colors = np.linspace(0.1, 0.4, 4)[:, None].repeat(3, 1)
    cloud = PointCloud(points[shuffled], np.zeros((4, 3)), colors[shuffled])
    config, pinhole = VoxelConfig(1e-6, 8, 0.1, 10), Pinhole((60.0, 60.0, 3.0, 2.0), 8, 5)
    depth, colors = draw_voxels(cloud, np.array(counts, float)[shuffled], np.eye(4), pinhole, config)
    assert depth[2, 3] == expected and (depth > 0).sum() == 9  # its own pixel, and one to each side
    assert colors[2, 3, 0] == pytest.approx({1.0: 0.1, 2.0: 0.2, 2.1: 0.3, 3.0: 0.4}[expected])


def test_baselines_are_chosen_one_by_one_several_or_all_and_wrong_values_are_named():
    assert baseline_configs(compose()) == {}
    assert set(baseline_configs(compose("baseline=voxel"))) == {"voxel"}
    for chosen in ("baseline=all", "baseline=[voxel,tsdf]"):
        found = baseline_configs(compose(chosen, "baseline.tsdf.truncation_m=0.1"))
        assert list(found) == ["voxel", "tsdf"] and found["tsdf"].truncation_m == 0.1
    with pytest.raises(ValueError, match="no option of baseline: there are all, none, tsdf, voxel"):  # a gate is none
        baseline_configs(compose("baseline=smoke"))
    with pytest.raises(ValueError, match="baseline.voxel.voxel_m must be a number from"):
        baseline_configs(compose("baseline=voxel", "baseline.voxel.voxel_m=0.0"))
    with pytest.raises(ValueError, match="truncation_m=0.01 is less than one voxel"):
        TsdfConfig(0.02, 0.01, 1)
