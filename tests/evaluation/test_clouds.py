"""Oracles: NumPy means per voxel, the whole against its pieces, Open3D's ICP."""

import numpy as np
import pytest
from cloud_scene import random_cloud
from scipy.spatial.transform import Rotation

from emgs_jax.evaluation.clouds import (
    NearestPoints,
    PointCloud,
    SpooledCloud,
    coarse_points,
    read_cloud,
    register,
    transform_cloud,
)
from emgs_jax.evaluation.clouds import spooled as spool
from emgs_jax.geometry import Sim3
from emgs_jax.io.ply import save_points_ply, structured, write_ply


def averaged(cloud, voxel):
    return spool([cloud], np.float64).averaged(voxel).cloud()


def test_points_of_a_voxel_become_their_means_and_twice_is_once():
    """Its normal is the direction of the mean, and zero where the sides cancel."""
    cloud = random_cloud(np.random.default_rng(7), 5000)
    small = averaged(cloud, 0.2)
    cells, inverse = np.unique(np.floor(cloud.points / 0.2), axis=0, return_inverse=True)
    rows = [inverse.ravel() == cell for cell in range(len(cells))]
    points, normals, colors = (
        np.stack([values[row].mean(0) for row in rows]) for values in (cloud.points, cloud.normals, cloud.colors)
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    assert 0.01 < (length < 0.1).mean() < 0.5, "both kinds of voxels are there"
    again, expected = averaged(small, 0.2), np.where(length > 0.1, normals / length, 0.0)
    for name, values in (("points", points), ("normals", expected), ("colors", colors)):
        np.testing.assert_allclose(getattr(small, name), values, rtol=0, atol=1e-12)
        np.testing.assert_allclose(getattr(again, name), getattr(small, name), atol=1e-12)


def test_of_few_points_all_are_the_nearest_and_of_none_there_are_none():
    points, queries = np.diag([1.0, 2.0, 3.0]), np.zeros((200, 3))
    distances, rows = NearestPoints(points).query(queries, 5)
    np.testing.assert_array_equal(distances, np.tile([1.0, 2.0, 3.0], (200, 1)))
    np.testing.assert_array_equal(rows, np.tile([0, 1, 2], (200, 1)))
    for nothing in (NearestPoints(points[:0]).query(queries), NearestPoints(points).query(queries[:0])):
        assert all(not values.size for values in nothing)


def test_a_similarity_moves_the_points_and_only_turns_the_normals():
    rng = np.random.default_rng(8)
    cloud = random_cloud(rng)
    move = Sim3(3.0, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    moved = transform_cloud(cloud, move)
    tips = (move.apply(cloud.points + cloud.normals) - move.apply(cloud.points)) / 3.0
    np.testing.assert_allclose(moved.points, move.apply(cloud.points), atol=1e-12)
    np.testing.assert_allclose(moved.normals, tips, atol=1e-12)
    np.testing.assert_array_equal(moved.colors, cloud.colors)


def test_fusing_pieces_is_reducing_the_whole_part_by_part(monkeypatch):
    """No more than a part is in memory; the pieces of a voxel may have come with any cloud. Rows are float32."""
    cloud = random_cloud(np.random.default_rng(4), 900)
    pieces = [PointCloud(cloud.points[i::7], cloud.normals[i::7], cloud.colors[i::7]) for i in range(7)]
    poisoned = PointCloud(np.full((5, 3), np.nan), np.zeros((5, 3)), np.zeros((5, 3)))
    whole = averaged(cloud, 0.1)
    monkeypatch.setattr("emgs_jax.evaluation.clouds.PART_ROWS", 50)
    monkeypatch.setattr("emgs_jax.evaluation.clouds.SOME", 3)
    spooled = SpooledCloud()
    for piece in (*pieces, poisoned):
        spooled.append(piece)
    means = spooled.averaged(0.1)
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(means.cloud(), name), getattr(whole, name), atol=3e-7)
    assert len(spooled) == means.counts().sum() == 900
    assert len(means.sizes) > 5 and max(means.sizes) < 200
    rows = np.array([0, 7, 8, len(means) - 1])
    np.testing.assert_array_equal(means.rows(rows)[:, :3], means.cloud().points[rows])


def test_coarse_points_of_parts_are_those_of_the_whole():
    points = random_cloud(np.random.default_rng(5), 900).points
    found, whole = (coarse_points(parts, 0.5) for parts in ([points[::2], points[1::2]], [points]))
    np.testing.assert_allclose(found, whole, atol=1e-12)


@pytest.mark.parametrize("num_steps", [1, 4])
def test_registration_takes_the_steps_of_open3ds_point_to_point_icp(num_steps):
    import open3d as o3d

    registration = o3d.pipelines.registration

    rng = np.random.default_rng(5)
    target = rng.uniform(-1, 1, (800, 3))
    motion = Rotation.from_rotvec([0.05, -0.02, 0.03]).as_matrix()
    points = target[:500] @ motion.T + [0.02, -0.03, 0.01] + 0.01 * rng.normal(size=(500, 3))
    found = register(points, NearestPoints(target), 0.15, num_steps)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rows)) for rows in (points, target)]
    criteria = registration.ICPConvergenceCriteria(0.0, 0.0, num_steps)
    expected = registration.registration_icp(*clouds, 0.15, np.eye(4), criteria=criteria).transformation
    np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found.translation, expected[:3, 3], atol=1e-9)


def test_registration_with_less_than_three_pairs_moves_nothing():
    points = np.random.default_rng(6).uniform(size=(20, 3))
    few = np.concatenate([points[:2] + 0.01, points[2:] + 100.0])
    for target in (points + 100.0, points[:0], few, few[1:]):
        found = register(points, NearestPoints(target), 0.03, 10)
        np.testing.assert_array_equal(found.apply(points), points)


def test_a_cloud_that_is_read_keeps_its_normals_and_colours(tmp_path):
    """Its normals are not those of planes through neighbours: they must come from the file."""
    cloud = random_cloud(np.random.default_rng(9))
    save_points_ply(tmp_path / "a.ply", cloud.points, cloud.normals, cloud.colors)
    found = read_cloud(tmp_path / "a.ply", 12)
    np.testing.assert_allclose(found.points, cloud.points, rtol=1e-6)
    np.testing.assert_allclose(found.normals, cloud.normals, rtol=1e-6)
    np.testing.assert_allclose(found.colors, cloud.colors, atol=0.5 / 255 + 1e-6)


def test_normals_of_a_mesh_whose_triangles_share_no_vertices_are_its_planes_and_those_of_a_line_unknown(tmp_path):
    """Neighbours that are one point six times have no plane, and (0, 0, 1) was taken for theirs."""
    x, y = (values.ravel() * 0.02 for values in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    grid = np.column_stack([x, 0.6 * y, 0.8 * y])
    line = np.column_stack([np.linspace(5.0, 6.0, 20), np.zeros(20), np.zeros(20)])
    points = np.repeat(np.concatenate([grid, line]), 6, axis=0).astype(np.float32)
    write_ply(tmp_path / "a.ply", structured(points, ["x", "y", "z"]))
    found = read_cloud(tmp_path / "a.ply", 12)
    np.testing.assert_allclose(np.abs(found.normals[: 6 * 400] @ [0.0, -0.8, 0.6]), 1.0, atol=1e-4)
    assert not found.normals[6 * 400 :].any() and not found.colors.any()


def test_normals_of_length_0_are_none_and_others_get_length_1(tmp_path):
    """3DGS writes zeros, which scored as 0 % of normals; and cosines of normals of length 2 were above 1."""
    rng = np.random.default_rng(11)
    points = rng.uniform(-1, 1, (300, 3)) * [1, 1, 0]
    normals = np.where(np.arange(300)[:, None] < 150, 0.0, [0.0, 0.0, -2.0])
    save_points_ply(tmp_path / "a.ply", points, normals, np.zeros((300, 3)))
    found = read_cloud(tmp_path / "a.ply", 12)
    np.testing.assert_allclose(np.abs(found.normals[:, 2]), 1.0, atol=1e-6)
    assert (found.normals[150:, 2] < 0).all()


@pytest.mark.parametrize(
    ("kind", "top"), [("uchar", 255), ("int", 255), ("float", 255), ("float", 1), ("ushort", 65535)]
)
def test_colours_are_fractions_in_whatever_kind_a_program_writes_them(kind, top, tmp_path):
    """Colours of int were nearly black, those of 0 … 255 in float came 255 times too bright."""
    names = "".join(f"property float {name}\n" for name in "xyz")
    names += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{x} 0 {x * x} {top} 0 0\n" for x in range(5))
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 5\n{names}end_header\n{rows}")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply", 4).colors, [[1.0, 0, 0]] * 5)
