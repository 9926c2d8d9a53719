"""Pose graphs in g2o's format; oracles: matrices, and the way back."""

import equinox as eqx
import numpy as np
import pytest
from g2o_reader import load_graph_g2o
from scipy.spatial.transform import Rotation

from emgs_jax.back_end.g2o import save_graph_g2o

RNG = np.random.default_rng(0)
ROOT = RNG.normal(size=(6, 6))
INFORMATION = ROOT @ ROOT.T + np.eye(6)
UPPER = " ".join(f"{x:.17g}" for x in INFORMATION[np.triu_indices(6)])
QUATERNIONS = Rotation.random(3, RNG).as_quat()
CENTERS = RNG.normal(size=(3, 3))
VERTICES = [
    f"VERTEX_SE3:QUAT {name} " + " ".join(f"{x:.17g}" for x in (*t, *q))
    for name, t, q in zip((7, 3, 40), CENTERS, QUATERNIONS, strict=True)
]
EDGES = [f"EDGE_SE3:QUAT 7 3 1 2 3 0 0 0 1 {UPPER}", f"EDGE_SE3:QUAT 40 7 1 0 0 0 0 0.6 0.8 {UPPER}"]


def matrix(center, quaternion):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), center
    return T


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "graph.g2o").write_text("\n".join([*VERTICES, *EDGES]))
    return load_graph_g2o(tmp_path / "graph.g2o")


def test_vertices_and_edges_are_what_the_lines_say(graph):
    expected = [matrix(t, q) for t, q in zip(CENTERS, QUATERNIONS, strict=True)]
    np.testing.assert_allclose(graph.nodes.T_world.as_matrix(), expected, atol=1e-6)
    assert graph.nodes.T_world.wxyz_xyz.dtype == np.float64
    np.testing.assert_array_equal([graph.factors.a, graph.factors.b], [[0, 2], [1, 0]])
    turned = matrix([1, 0, 0], [0, 0, 0.6, 0.8])
    np.testing.assert_allclose(graph.factors.Z_a_b.as_matrix(), [matrix([1, 2, 3], [0, 0, 0, 1]), turned], atol=1e-6)
    np.testing.assert_array_equal(graph.factors.is_loop, [False, True])
    roots = np.asarray(graph.factors.sqrt_info)
    np.testing.assert_allclose((roots.transpose(0, 2, 1) @ roots)[:, :6, :6], [INFORMATION] * 2, atol=1e-9)
    assert not roots[:, 6].any() and not roots[:, :, 6].any()


def test_what_is_written_comes_back(graph, tmp_path):
    save_graph_g2o(tmp_path / "again.g2o", graph)
    again = load_graph_g2o(tmp_path / "again.g2o")
    for one, other in zip(
        (graph.nodes.T_world.wxyz_xyz, graph.factors.Z_a_b.wxyz_xyz, graph.factors.a, graph.factors.b),
        (again.nodes.T_world.wxyz_xyz, again.factors.Z_a_b.wxyz_xyz, again.factors.a, again.factors.b),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-15)
    information = [np.einsum("nki,nkj->nij", *2 * [np.asarray(g.factors.sqrt_info)]) for g in (graph, again)]
    np.testing.assert_allclose(*information, atol=1e-9)


def test_scales_are_not_written_silently(graph, tmp_path):
    scaled = eqx.tree_at(lambda g: g.nodes.log_scale, graph, graph.nodes.log_scale + 0.1)
    with pytest.raises(ValueError, match="no scales"):
        save_graph_g2o(tmp_path / "again.g2o", scaled)
    assert not (tmp_path / "again.g2o").exists()
