"""Oracles: bit-for-bit reloading, other programs' readers, covariances from written parameters, broken files."""

import json
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from emgs_jax.export import (
    load_map_npz,
    load_trajectory_tum,
    save_gaussians_ply,
    save_map_npz,
    save_mesh_ply,
    save_points_ply,
    save_trajectory_tum,
)

LAYOUT = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
LAYOUT += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


class Leaves(eqx.Module):
    """Stands in for Gaussians."""

    means: Float[Array, "n 3"]
    features: Float[Array, "n f"]
    valid: Bool[Array, " n"]


class Map(eqx.Module):
    """Stands in for GaussianMap: a nested module, bookkeeping and a static field."""

    gaussians: Leaves
    gain: Float[Array, " n"]
    count: Int[Array, ""]
    capacity: int = eqx.field(static=True)


class Other(eqx.Module):
    gain: Float[Array, " n"]


def a_map(n=5, f=2):
    means = jnp.asarray(np.random.default_rng(0).normal(size=(n, 3)), jnp.float32).at[0, 0].set(jnp.nan)
    gaussians = Leaves(means, jnp.ones((n, f), jnp.float16), jnp.arange(n) % 2 == 0)
    return Map(gaussians, jnp.full(n, -0.0), jnp.asarray(3, jnp.int32), n)


def assert_same(a, b):
    assert jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)
    for x, y in zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("width", [0, 2])
def test_a_map_reloads_bit_for_bit_from_its_class_or_an_instance(tmp_path, width):
    tree = a_map(f=width)
    save_map_npz(tmp_path / "map.npz", tree)
    assert_same(load_map_npz(tmp_path / "map.npz", Map), tree)
    assert_same(load_map_npz(tmp_path / "map.npz", a_map(n=9)), tree)
    save_map_npz(tmp_path / "again.npz", tree)
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    with np.load(tmp_path / "map.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {
            *("gaussians.means", "gaussians.features", "gaussians.valid"),
            *("gain", "count", "__header__"),
        }


def test_truncated_or_flipped_maps_raise_value_error_or_hold_the_same(tmp_path):
    path = tmp_path / "map.npz"
    tree = a_map()
    save_map_npz(path, tree)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    damaged = [whole[:length] for length in (0, 1, 30, len(whole) // 2, len(whole) - 1)]
    for position in np.linspace(0, len(whole) - 1, 500).astype(int):
        flipped = bytearray(whole)
        flipped[position] ^= 1 << rng.integers(8)
        damaged.append(bytes(flipped))
    rejected = 0
    for content in damaged:
        path.write_bytes(content)
        try:
            assert_same(load_map_npz(path, Map), tree)
        except ValueError as error:
            rejected += 1
            assert "map.npz" in str(error)
    assert rejected > 250


def test_foreign_and_newer_maps_are_named_with_the_remedy(tmp_path):
    path = tmp_path / "map.npz"
    np.savez(path, gain=np.ones(3))
    with pytest.raises(ValueError, match=r"map\.npz is not a map of emgs_jax"):
        load_map_npz(path, Other)
    header = {"format": "emgs_jax.map", "version": 99, "class": "Other", "leaves": ["gain"], "static": {}}
    np.savez(path, __header__=np.array(json.dumps(header)), gain=np.ones(3))
    with pytest.raises(ValueError, match="map version 99, this code reads 1"):
        load_map_npz(path, Other)
    save_map_npz(path, a_map())
    with pytest.raises(ValueError, match="holds a Map, expected Other"):
        load_map_npz(path, Other)
    np.savez(path, __header__=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="not a readable map"):
        load_map_npz(path, Other)
    with pytest.raises(FileNotFoundError):
        load_map_npz(tmp_path / "none.npz", Other)
    with pytest.raises(ValueError, match="'gain' is float"):
        save_map_npz(path, Other(1.0))


def test_written_gaussians_give_back_colour_opacity_and_covariance(tmp_path):
    rng = np.random.default_rng(2)
    factors = rng.normal(size=(20, 3, 3)) * np.array([0.2, 0.05, 0.005])
    covs = np.einsum("nik,njk->nij", factors, factors)
    means, colors, opacity = rng.normal(size=(20, 3)), rng.uniform(size=(20, 3)), rng.uniform(0.1, 0.9, 20)
    means[7, 1] = np.nan
    assert save_gaussians_ply(tmp_path / "map.ply", means, covs, colors, opacity) == 19
    body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n", 1)[1]
    rows = np.frombuffer(body, "<f4").reshape(19, len(LAYOUT)).astype(np.float64)
    keep = np.arange(20) != 7
    dc, logit, scales, quaternions = rows[:, 6:9], rows[:, 9], rows[:, 10:13], rows[:, 13:]
    rotations = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    found = np.einsum("nik,nk,njk->nij", rotations, np.exp(2.0 * scales), rotations)
    np.testing.assert_allclose(rows[:, :3], means[keep], rtol=1e-6)
    np.testing.assert_allclose(found, covs[keep], rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * dc, colors[keep], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-logit)), opacity[keep], atol=1e-6)


def test_the_header_of_the_gaussians_is_the_layout_of_common_viewers(tmp_path):
    for n in (0, 1):
        covs = np.tile(np.eye(3), (n, 1, 1))
        assert save_gaussians_ply(tmp_path / "map.ply", np.ones((n, 3)), covs, np.ones((n, 3)), 0.5) == n
        content = (tmp_path / "map.ply").read_bytes()
        header, body = content.split(b"end_header\n")
        names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float")]
        assert names == LAYOUT
        assert b"format binary_little_endian 1.0" in header
        assert len(body) == 4 * len(LAYOUT) * n


def test_written_points_are_read_by_trimesh_and_open3d(tmp_path):
    trimesh, o3d = pytest.importorskip("trimesh"), pytest.importorskip("open3d")
    rng = np.random.default_rng(3)
    points, normals, colors = rng.normal(size=(30, 3)), rng.normal(size=(30, 3)), rng.integers(0, 256, (30, 3))
    assert save_points_ply(tmp_path / "points.ply", points, normals, colors / 255.0) == 30
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_allclose(cloud.vertices, points, rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], colors)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(np.asarray(cloud.normals), normals, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors), colors / 255.0, atol=1e-9)


def test_labels_are_a_property_of_the_points_and_the_header_names_the_classes(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    points = np.arange(9.0).reshape(3, 3)
    points[1] = np.nan  # left out, with its label
    save_points_ply(tmp_path / "p.ply", points, points, np.zeros((3, 3)), np.array([4, 5, -1]), ("wall", "sofä"))
    cloud = trimesh.load(tmp_path / "p.ply")
    np.testing.assert_array_equal(cloud.metadata["_ply_raw"]["vertex"]["data"]["label"].ravel(), [4, -1])
    header = (tmp_path / "p.ply").read_bytes().split(b"end_header")[0]
    assert b"comment label 0 wall\ncomment label 1 sof?\n" in header


def test_a_mesh_of_an_open_sphere_lies_on_it_stays_open_and_is_the_same_twice(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] < 0.5]
    colors = np.tile([1.0, 0.0, 0.0], (len(normals), 1))
    contents = []
    for name in ("a.ply", "b.ply"):
        assert save_mesh_ply(tmp_path / name, 2.0 * normals, normals, colors, depth=6) is None
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    mesh = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, atol=0.08)
    # The cap above 1 is trimmed but for about two spacings of .2; Poisson alone closes it up to 2.
    assert mesh.vertices[:, 2].max() < 1.4
    assert 0.9 < mesh.area / (0.75 * 16.0 * np.pi) < 1.1
    np.testing.assert_array_equal(
        np.asarray(mesh.visual.vertex_colors)[:, :3], np.tile([255, 0, 0], (len(mesh.vertices), 1))
    )


def test_a_mesh_that_cannot_be_made_gives_a_reason_and_no_file(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"of an older run")
    few = np.random.default_rng(5).normal(size=(49, 3))
    assert "at least 50" in save_mesh_ply(path, few, few / np.linalg.norm(few, axis=1, keepdims=True), np.abs(few))
    many = np.full((100, 3), np.nan)
    assert "0 points" in save_mesh_ply(path, many, many, many)
    assert os.listdir(tmp_path) == []


def test_a_trajectory_comes_back_with_unit_quaternions_in_tum_order(tmp_path):
    rng = np.random.default_rng(6)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.random(9, rng).as_matrix(), rng.normal(size=(9, 3))
    stamps = 1305031098.6659 + np.arange(9) / 30
    save_trajectory_tum(tmp_path / "trajectory.txt", stamps, poses)
    times, loaded = load_trajectory_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(times, stamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(loaded, poses, atol=5e-9)
    quarter = np.eye(4)
    quarter[:3, :3], quarter[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3]
    save_trajectory_tum(tmp_path / "trajectory.txt", [0.5], quarter[None])
    row = [float(field) for field in (tmp_path / "trajectory.txt").read_text().splitlines()[1].split()]
    np.testing.assert_allclose(row, [0.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    save_trajectory_tum(tmp_path / "trajectory.txt", [], np.empty((0, 4, 4)))
    assert load_trajectory_tum(tmp_path / "trajectory.txt")[1].shape == (0, 4, 4)


@pytest.mark.parametrize("line", ["1 2 3", "1 0 0 0 0 0 0 0", "1 a 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1", "\x00\xff"])
def test_a_broken_trajectory_names_file_and_line(tmp_path, line):
    (tmp_path / "t.txt").write_text("# comment\n0 0 0 0 0 0 0 1\n" + line + "\n", encoding="latin-1")
    with pytest.raises(ValueError, match=r"t\.txt:3: expected"):
        load_trajectory_tum(tmp_path / "t.txt")
    with pytest.raises(ValueError, match="finite"):
        save_trajectory_tum(tmp_path / "t.txt", [0.0], np.full((1, 4, 4), np.nan))
