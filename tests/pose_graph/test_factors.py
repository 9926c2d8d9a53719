"""Residuals of the pose graph: what they are, their derivatives, and the kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rings import disturb, join, log, matrices_of, measure, put, walk, window_pairs

from emgs_jax.pose_graph import factors
from emgs_jax.pose_graph.factors import PoseGraph

residuals, linearize, move, robust = (
    jax.jit(f) for f in (factors.residuals, factors.linearize, factors.move, factors.robust)
)


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def small_graph(seed: int = 0) -> PoseGraph:
    truth = walk(9, laps=1.0, scale_std=0.2, seed=seed)
    return PoseGraph(disturb(truth, np.random.default_rng(seed), 0.2), measure(truth, window_pairs(9, (1, 3))))


def test_the_residual_is_the_printed_one_with_matrices(double):
    """Independent of jaxlie's group products: 4×4 matrices and the matrix logarithm."""
    from scipy.linalg import logm

    graph = small_graph()
    nodes, edges = jax.device_get((graph.nodes, graph.factors))
    matrices, measured, expected = matrices_of(nodes.T_world), matrices_of(edges.Z_a_b), []
    for row, (a, b) in enumerate(zip(edges.a, edges.b, strict=True)):
        T = np.linalg.inv(matrices[a]) @ matrices[b]
        T[:3, 3] *= np.exp(-nodes.log_scale[a])
        log = logm(np.linalg.inv(measured[row]) @ T).real
        scale = nodes.log_scale[b] - nodes.log_scale[a] - edges.log_ratio[row]
        tangent = np.array([*log[:3, 3], log[2, 1], log[0, 2], log[1, 0], scale])
        expected.append(edges.sqrt_info[row] @ tangent)
    np.testing.assert_allclose(residuals(graph), expected, atol=1e-6)


def test_jacobians_are_finite_differences_of_the_step(double):
    graph = small_graph(1)
    value, jacobian = linearize(graph)
    np.testing.assert_allclose(value, residuals(graph), atol=1e-12)
    both = np.stack([graph.factors.a, graph.factors.b])
    for column in range(14):
        node, degree = divmod(column, 7)
        steps = np.zeros((2, 9, 7))
        steps[:, both[node, 0], degree] = 1e-6, -1e-6
        plus, minus = (np.asarray(residuals(PoseGraph(move(graph.nodes, step), graph.factors)))[0] for step in steps)
        np.testing.assert_allclose(np.asarray(jacobian)[0, :, column], (plus - minus) / 2e-6, atol=1e-5)


def test_float32_is_float64_to_its_rounding():
    with jax.enable_x64(True):
        graph = small_graph()
        exact = [np.asarray(x) for x in linearize(graph)]
        values = jax.tree.map(np.asarray, graph)
    single = jax.tree.map(lambda x: jnp.asarray(x.astype(np.float32) if x.dtype == np.float64 else x), values)
    for rough, fine in zip(linearize(single), exact, strict=True):
        assert rough.dtype == jnp.float32
        np.testing.assert_allclose(rough, fine, atol=2e-6 * np.abs(fine).max())


def with_padding(graph: PoseGraph) -> PoseGraph:
    """Rows that are not in use hold NaN, and an edge that is in use leads to such a node."""
    nan = lambda leaf: np.full((2, *leaf.shape[1:]), np.nan if leaf.dtype == np.float64 else 0, leaf.dtype)  # noqa: E731
    pad = lambda tree: join(tree, jax.tree.map(nan, tree))  # noqa: E731
    count = graph.factors.a.shape[0]
    in_use = np.arange(count + 2) <= count
    edges = put(pad(graph.factors), valid=in_use, b=lambda b: np.where(np.arange(count + 2) == count, 9, b))
    return PoseGraph(pad(graph.nodes), edges)


def test_what_is_not_in_use_is_zero_with_finite_derivatives(double):
    graph = small_graph()
    padded = with_padding(graph)
    for plain, filled in zip(linearize(graph), linearize(padded), strict=True):
        np.testing.assert_allclose(np.asarray(filled)[:-2], plain, rtol=0, atol=1e-10)  # roundings of another program
        np.testing.assert_array_equal(np.asarray(filled)[-2:], 0.0)


@pytest.mark.parametrize(("end", "row"), [("a", -1), ("b", -1), ("a", 9), ("b", 9)])
def test_an_edge_to_a_node_that_is_not_there_is_not_in_use(end, row):
    graph = small_graph()
    edges = put(graph.factors, **{end: lambda rows: np.where(np.arange(len(rows)) == 0, row, rows)})
    in_use = factors.factors_in_use(PoseGraph(graph.nodes, edges))
    np.testing.assert_array_equal(in_use, np.arange(len(in_use)) > 0)


def test_the_kernel_s_weight_is_the_derivative_of_its_cost(double):
    chi2 = np.array([0.0, 1.0, 16.7, 16.9, 40.0, 1e4, 1e8])
    is_loop, phi = np.ones(7, bool), 16.8
    slope = jax.jit(jax.grad(lambda chi2: jnp.sum(robust(chi2, is_loop, phi)[0])))(chi2)  # each cost has its own chi2
    cost, weight = (np.asarray(x) for x in robust(chi2, is_loop, phi))
    np.testing.assert_allclose(2.0 * np.asarray(slope), weight, rtol=1e-9)
    assert (cost[:3] == 0.5 * chi2[:3]).all() and (cost <= 1.5 * phi).all() and (np.diff(cost) > 0).all()


def test_a_window_s_edges_and_an_infinite_kernel_are_quadratic(double):
    chi2 = np.array([0.0, 1.0, 16.7, 16.9, 40.0, 1e4, 1e8])
    for is_loop, phi in ((False, 16.8), (True, np.inf)):
        cost, weight = robust(chi2, np.full(7, is_loop), phi)
        np.testing.assert_array_equal(cost, 0.5 * chi2)
        np.testing.assert_array_equal(weight, 1.0)


def test_a_step_is_a_right_perturbation(double):
    nodes = walk(9)
    steps = np.random.default_rng(0).normal(size=(9, 7))
    moved = move(nodes, steps)
    between = np.linalg.inv(matrices_of(nodes.T_world)) @ matrices_of(moved.T_world)
    np.testing.assert_allclose(log(between), steps[:, :6], atol=1e-9)
    np.testing.assert_array_equal(moved.log_scale, np.asarray(nodes.log_scale) + steps[:, 6])
