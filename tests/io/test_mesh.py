"""Oracles: a sphere, and a reason where there is no mesh."""

import os

import numpy as np
import trimesh

from emgs_jax.io.mesh import save_mesh_ply


def sphere(count: int = 3000) -> np.ndarray:
    normals = np.random.default_rng(4).normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_a_mesh_of_an_open_sphere_lies_on_it_stays_open_has_its_colours_and_is_the_same_twice(tmp_path):
    normals = sphere()
    normals = normals[normals[:, 2] < 0.5]
    colors = np.where(normals[:, :1] > 0, [1.0, 0, 0], [0, 0, 1.0])
    contents = []
    for name in ("a.ply", "b.ply"):
        assert save_mesh_ply(tmp_path / name, 2.0 * normals, normals, (2.0 * normals, colors), depth=6) is None
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    mesh = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, atol=0.08)
    # The cap above 1 is trimmed but for about two spacings of .2; Poisson alone closes it up to 2.
    assert mesh.vertices[:, 2].max() < 1.4
    assert 0.9 < mesh.area / (0.75 * 16.0 * np.pi) < 1.1
    # A vertex has the colour of the point next to it.
    red, clear = np.asarray(mesh.visual.vertex_colors)[:, 0] == 255, np.abs(mesh.vertices[:, 0]) > 0.2  # two spacings
    assert clear.sum() > 100
    np.testing.assert_array_equal(red[clear], mesh.vertices[clear, 0] > 0)


def test_a_mesh_that_cannot_be_made_gives_a_reason_and_no_file(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"of an older run")
    few = sphere(49)
    assert "at least 50" in save_mesh_ply(path, few, few, (few, np.abs(few)))
    many = np.full((100, 3), np.nan)
    assert "0 points" in save_mesh_ply(path, many, many, (many, many))
    assert os.listdir(tmp_path) == []


def test_a_point_that_flew_far_away_does_not_make_the_cells_coarse(tmp_path):
    """The solver's grid spans all points: with depth 6 and a point at 200 m a cell would be wider than the sphere."""
    normals = sphere()
    points, directions = np.vstack([2.0 * normals, [[200.0, 0, 0]]]), np.vstack([normals, [[1.0, 0, 0]]])
    assert save_mesh_ply(tmp_path / "mesh.ply", points, directions, (points, np.ones_like(points)), depth=6) is None
    mesh = trimesh.load(tmp_path / "mesh.ply")
    assert len(mesh.vertices) > 500
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, atol=0.08)
