"""Oracles: NumPy means per voxel, the whole against its pieces, Open3D's ICP."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds, register, voxel_downsample


def random_cloud(rng, n=400):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(rng.uniform(-1, 1, (n, 3)), normals, rng.uniform(size=(n, 3)))


def test_points_of_a_voxel_become_their_mean_and_twice_is_once():
    rng = np.random.default_rng(3)
    cloud = random_cloud(rng, 5000)
    small = voxel_downsample(cloud, 0.2)
    cells, inverse = np.unique(np.floor(cloud.points / 0.2), axis=0, return_inverse=True)
    means = np.stack([cloud.points[inverse.ravel() == cell].mean(0) for cell in range(len(cells))])
    np.testing.assert_allclose(small.points, means, rtol=0, atol=1e-12)
    again = voxel_downsample(small, 0.2)
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(again, name), getattr(small, name), atol=1e-12)


def test_fusing_pieces_is_reducing_the_whole(monkeypatch):
    monkeypatch.setattr("emgs_jax.evaluation.clouds._MERGE_ROWS", 50)
    cloud = random_cloud(np.random.default_rng(4), 900)
    pieces = [PointCloud(cloud.points[i::7], cloud.normals[i::7], cloud.colors[i::7]) for i in range(7)]
    whole, fused = voxel_downsample(cloud, 0.1), fuse_clouds(iter(pieces), 0.1)
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(fused, name), getattr(whole, name), atol=1e-12)
    poisoned = PointCloud(cloud.points.copy(), cloud.normals, cloud.colors)
    poisoned.points[::2] = np.nan
    assert np.isfinite(voxel_downsample(poisoned, 0.1).points).all()
    assert len(voxel_downsample(poisoned, 1e-6)) == 450


@pytest.mark.parametrize("num_steps", [1, 4])
def test_registration_takes_the_steps_of_open3ds_point_to_point_icp(num_steps):
    registration = pytest.importorskip("open3d").pipelines.registration
    import open3d as o3d

    rng = np.random.default_rng(5)
    target = rng.uniform(-1, 1, (800, 3))
    motion = Rotation.from_rotvec([0.05, -0.02, 0.03]).as_matrix()
    points = target[:500] @ motion.T + [0.02, -0.03, 0.01] + 0.01 * rng.normal(size=(500, 3))
    found = register(points, cKDTree(target), 0.15, num_steps)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rows)) for rows in (points, target)]
    criteria = registration.ICPConvergenceCriteria(0.0, 0.0, num_steps)
    expected = registration.registration_icp(*clouds, 0.15, np.eye(4), criteria=criteria).transformation
    np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found.translation, expected[:3, 3], atol=1e-9)


def test_registration_without_pairs_moves_nothing():
    points = np.random.default_rng(6).uniform(size=(20, 3))
    for target in (points + 100.0, points[:0]):
        found = register(points, cKDTree(target), 0.1, 10)
        np.testing.assert_array_equal(found.apply(points), points)
