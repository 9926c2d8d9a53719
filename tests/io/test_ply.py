"""Oracles: other programs' readers, and covariances from the written parameters."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from emgs_jax.io.ply import save_gaussians_ply, save_points_ply

LAYOUT = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
LAYOUT += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def test_written_gaussians_give_back_colour_opacity_and_covariance_in_the_layout_of_common_viewers(tmp_path):
    rng = np.random.default_rng(2)
    factors = rng.normal(size=(20, 3, 3)) * np.array([0.2, 0.05, 0.005])
    covs = np.einsum("nik,njk->nij", factors, factors)
    means, colors, opacity = rng.normal(size=(20, 3)), rng.uniform(size=(20, 3)), rng.uniform(0.1, 0.9, 20)
    means[7, 1] = np.nan
    assert save_gaussians_ply(tmp_path / "map.ply", means, covs, colors, opacity) == 19
    header, body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float")]
    assert names == LAYOUT and b"format binary_little_endian 1.0" in header
    rows = np.frombuffer(body, "<f4").reshape(19, len(LAYOUT)).astype(np.float64)
    keep = np.arange(20) != 7
    dc, logit, scales, quaternions = rows[:, 6:9], rows[:, 9], rows[:, 10:13], rows[:, 13:]
    rotations = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    found = np.einsum("nik,nk,njk->nij", rotations, np.exp(2.0 * scales), rotations)
    np.testing.assert_allclose(rows[:, :3], means[keep], rtol=1e-6)
    np.testing.assert_allclose(found, covs[keep], rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * dc, colors[keep], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-logit)), opacity[keep], atol=1e-6)
    assert save_gaussians_ply(tmp_path / "map.ply", means[:0], covs[:0], colors[:0], 0.5) == 0
    assert (tmp_path / "map.ply").read_bytes().endswith(b"end_header\n")


def test_labels_are_a_property_of_the_points_and_the_header_names_the_classes(tmp_path):
    points = np.arange(9.0).reshape(3, 3)
    points[1] = np.nan  # left out, with its label
    save_points_ply(tmp_path / "p.ply", points, points, np.zeros((3, 3)), np.array([4, 5, -1]), ("wall", "sofä"))
    cloud = trimesh.load(tmp_path / "p.ply")
    np.testing.assert_array_equal(cloud.metadata["_ply_raw"]["vertex"]["data"]["label"].ravel(), [4, -1])
    header = (tmp_path / "p.ply").read_bytes().split(b"end_header")[0]
    assert b"comment label 0 wall\ncomment label 1 sof?\n" in header


def test_written_points_are_read_by_trimesh_and_open3d_with_colours_rounded_to_the_nearest_of_256(tmp_path):
    import open3d as o3d

    rng = np.random.default_rng(3)
    points, normals, colors = rng.normal(size=(30, 3)), rng.normal(size=(30, 3)), rng.integers(0, 256, (30, 3)) / 255
    colors[:3] = [[0.999, 0.5, 0.001], [1.3, -0.2, np.nan], [254.6 / 255, 254.4 / 255, 1.0]]
    expected = np.rint(255 * colors[3:])
    expected = np.concatenate([[[255, 128, 0], [255, 0, 0], [255, 254, 255]], expected])  # out of range: to the ends
    assert save_points_ply(tmp_path / "points.ply", points, normals, colors) == 30
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_allclose(cloud.vertices, points, rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], expected)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(np.asarray(cloud.normals), normals, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors), expected / 255.0, atol=1e-9)
