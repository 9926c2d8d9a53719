"""Pose graphs in g2o's format; oracles: matrices, g2o's own definition of its error, and the way there and back."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.back_end.g2o import load_graph_g2o, save_graph_g2o
from emgs_jax.pose_graph.factors import residuals

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


def written(folder, *lines: str):
    (folder / "graph.g2o").write_text("\n".join(lines))
    return folder / "graph.g2o"


def matrix(center, quaternion):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), center
    return T


def test_vertices_and_edges_are_what_the_lines_say(tmp_path):
    graph = load_graph_g2o(written(tmp_path, "# a comment", *VERTICES, "", "FIX 7", *EDGES))
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


def test_half_angles_are_the_error_that_g2o_defines(tmp_path):
    """χ² of (translation, vector part of the quaternion) of Z⁻¹ T_a⁻¹ T_b, near 0."""
    lines = VERTICES[:1], f"EDGE_SE3:QUAT 7 3 0 0 0 0 0 0 1 {UPPER}"
    small = np.array([1e-4, -2e-4, 3e-4]), np.array([2e-4, 1e-4, -1e-4])
    T = matrix(CENTERS[0], QUATERNIONS[0]) @ matrix(small[0], Rotation.from_rotvec(small[1]).as_quat())
    other = " ".join(f"{x:.17g}" for x in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()))
    path = written(tmp_path, *lines[0], f"VERTEX_SE3:QUAT 3 {other}", lines[1])
    for half_angles in (True, False):
        error = np.concatenate([small[0], (0.5 if half_angles else 1.0) * small[1]])
        with jax.enable_x64(True):
            found = residuals(load_graph_g2o(path, half_angles))
        assert float(np.sum(np.asarray(found) ** 2)) == pytest.approx(error @ INFORMATION @ error, rel=1e-3)


@pytest.mark.parametrize("half_angles", [False, True])
def test_what_is_written_comes_back(tmp_path, half_angles):
    graph = load_graph_g2o(written(tmp_path, *VERTICES, *EDGES), half_angles)
    save_graph_g2o(tmp_path / "again.g2o", graph, half_angles)
    again = load_graph_g2o(tmp_path / "again.g2o", half_angles)
    for one, other in zip(
        (graph.nodes.T_world.wxyz_xyz, graph.factors.Z_a_b.wxyz_xyz, graph.factors.a, graph.factors.b),
        (again.nodes.T_world.wxyz_xyz, again.factors.Z_a_b.wxyz_xyz, again.factors.a, again.factors.b),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-15)
    np.testing.assert_allclose(graph.factors.sqrt_info, again.factors.sqrt_info, atol=1e-9)


def test_information_of_less_than_full_rank_is_read_and_scales_are_not_written_silently(tmp_path):
    upper = " ".join(f"{x:g}" for x in np.diag([1.0, 4, 0, 0, 0, 9])[np.triu_indices(6)])
    graph = load_graph_g2o(written(tmp_path, *VERTICES, f"EDGE_SE3:QUAT 7 3 0 0 0 0 0 0 1 {upper}"))
    root = np.asarray(graph.factors.sqrt_info[0])
    np.testing.assert_allclose(np.diag(root.T @ root), [1, 4, 0, 0, 0, 9, 0], atol=1e-12)
    scaled = eqx.tree_at(lambda g: g.nodes.log_scale, graph, graph.nodes.log_scale + 0.1)
    with pytest.raises(ValueError, match="no scales"):
        save_graph_g2o(tmp_path / "again.g2o", scaled)
    assert not (tmp_path / "again.g2o").exists()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([*VERTICES, "EDGE_SE3:QUAT 7 3 1 2 3"], r"graph.g2o:4: expected `EDGE_SE3:QUAT id id x y z"),
        ([VERTICES[0], "VERTEX_SE3:QUAT 3 0 0 x 0 0 0 1"], r"graph.g2o:2: expected `VERTEX_SE3:QUAT id x y z"),
        (["VERTEX_SE3:QUAT 3 0 0 nan 0 0 0 1"], "graph.g2o:1: expected .*, finite"),
        (["VERTEX_SE3:QUAT 3 0 0 0 0 0 0 0"], "graph.g2o:1: the quaternion .* 0 0 0 1 is none"),
        (["VERTEX_SE2 0 1 2 3"], "graph.g2o:1: 'VERTEX_SE2' is not read, .*convert it"),
        ([*VERTICES, VERTICES[1]], "graph.g2o:4: vertex 3 stands here a second time: remove one"),
        ([*VERTICES, EDGES[0].replace(" 7 3 ", " 7 8 ")], "graph.g2o:4: vertex 8 has no line VERTEX.*: add it"),
        (
            [*VERTICES, EDGES[0], EDGES[0].replace(UPPER, "-1 " + UPPER.split(" ", 1)[1])],
            "graph.g2o:5: the information is not positive semidefinite: its 21 numbers",
        ),
        (VERTICES, "graph.g2o: needs lines VERTEX_SE3:QUAT and EDGE_SE3:QUAT; found 3 and 0"),
    ],
)
def test_a_broken_line_is_named_with_its_remedy(tmp_path, lines, message):
    with pytest.raises(ValueError, match=message):
        load_graph_g2o(written(tmp_path, *lines))
