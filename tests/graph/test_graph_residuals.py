"""Residuals of the pose graph: what they are, their derivatives, and the kernel."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from rings import disturb, measure, walk, window_pairs

from emgs_jax.graph.measurements import LOOP, ODOMETRY, Edges, Graph, Nodes, linearize, move, residuals, robust


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def small_graph(seed: int = 0) -> Graph:
    truth = walk(9, laps=1.0, scale_std=0.2, seed=seed)
    return Graph(disturb(truth, np.random.default_rng(seed), 0.2), measure(truth, window_pairs(9, (1, 3))))


def test_exact_measurements_have_no_residual(double):
    truth = walk(9, scale_std=0.3)
    np.testing.assert_allclose(residuals(Graph(truth, measure(truth, window_pairs(9)))), 0.0, atol=1e-9)


def test_the_residual_is_the_printed_one_with_matrices(double):
    """Independent of jaxlie's group products: 4×4 matrices and the matrix logarithm."""
    from scipy.linalg import logm

    graph = small_graph()
    nodes, edges = graph.nodes, graph.edges
    matrices, expected = np.asarray(nodes.T_world.as_matrix()), []
    for row, (a, b) in enumerate(zip(edges.a, edges.b, strict=True)):
        T = np.linalg.inv(matrices[a]) @ matrices[b]
        T[:3, 3] *= np.exp(-nodes.log_scale[a])
        log = logm(np.linalg.inv(edges.Z_a_b.as_matrix()[row]) @ T).real
        scale = nodes.log_scale[b] - nodes.log_scale[a] - edges.log_ratio[row]
        tangent = np.array([*log[:3, 3], log[2, 1], log[0, 2], log[1, 0], scale])
        expected.append(np.asarray(edges.sqrt_info[row]) @ tangent)
    np.testing.assert_allclose(residuals(graph), expected, atol=1e-6)


def test_the_inference_with_larger_depths_has_the_smaller_scale(double):
    """Node 1 sees everything twice as far as node 0: depth ratio 1/2, and σ_1 − σ_0 = log ½ explains it."""
    nodes = Nodes(jaxlie.SE3.identity((2,)), jnp.asarray([0.0, np.log(0.5)]), jnp.ones(2, bool))
    edges = eqx.tree_at(lambda e: e.log_ratio, measure(nodes, [(0, 1)]), jnp.log(jnp.asarray([2.0 / 4.0])))
    np.testing.assert_allclose(residuals(Graph(nodes, edges))[:, 6], 0.0, atol=1e-12)


def test_a_translation_is_measured_in_units_of_a(double):
    """Node 0's inference is half as large as the map: 2 m in the map are 1 in its units."""
    T = jaxlie.SE3.from_translation(jnp.asarray([[0.0, 0, 0], [2.0, 0, 0]]))
    nodes = Nodes(T, jnp.asarray([np.log(2.0), 0.0]), jnp.ones(2, bool))
    measured = jaxlie.SE3.from_translation(jnp.asarray([[1.0, 0, 0]]))
    edges = eqx.tree_at(lambda e: e.Z_a_b, measure(nodes, [(0, 1)]), measured)
    np.testing.assert_allclose(residuals(Graph(nodes, edges)), 0.0, atol=1e-12)


def test_jacobians_are_finite_differences_of_the_step(double):
    graph = small_graph(1)
    value, jacobian = linearize(graph)
    np.testing.assert_allclose(value, residuals(graph), atol=1e-12)
    both, call = np.stack([graph.edges.a, graph.edges.b]), jax.jit(residuals)
    for column in range(14):
        node, degree = divmod(column, 7)
        steps = np.zeros((2, 9, 7))
        steps[:, both[node, 0], degree] = 1e-6, -1e-6
        plus, minus = (call(Graph(move(graph.nodes, jnp.asarray(step)), graph.edges))[0] for step in steps)
        np.testing.assert_allclose(jacobian[0, :, column], (plus - minus) / 2e-6, atol=1e-5)


def test_float32_is_float64_to_its_rounding():
    with jax.enable_x64(True):
        graph = small_graph()
        exact = [np.asarray(x) for x in linearize(graph)]
        values = jax.tree.map(np.asarray, graph)
    single = jax.tree.map(lambda x: jnp.asarray(x.astype(np.float32) if x.dtype == np.float64 else x), values)
    for rough, fine in zip(linearize(single), exact, strict=True):
        assert rough.dtype == jnp.float32
        np.testing.assert_allclose(rough, fine, atol=2e-6 * np.abs(fine).max())


def with_padding(graph: Graph) -> Graph:
    """Rows that are not in use hold NaN, and an edge that is in use leads to such a node."""
    nan = lambda leaf: jnp.full((2, *leaf.shape[1:]), jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0)  # noqa: E731
    pad = lambda tree: jax.tree.map(lambda leaf: jnp.concatenate([leaf, nan(leaf).astype(leaf.dtype)]), tree)  # noqa: E731
    nodes, edges = pad(graph.nodes), pad(graph.edges)
    to_nowhere = graph.edges.a.shape[0]
    edges = eqx.tree_at(lambda e: (e.valid, e.b), edges, (edges.valid.at[to_nowhere].set(True), edges.b.at[-2].set(9)))
    return Graph(nodes, edges)


def test_what_is_not_in_use_is_zero_with_finite_derivatives(double):
    graph = small_graph()
    padded = with_padding(graph)
    for plain, filled in zip(linearize(graph), linearize(padded), strict=True):
        np.testing.assert_array_equal(filled[:-2], plain)
        np.testing.assert_array_equal(filled[-2:], 0.0)


def test_the_kernel_s_weight_is_the_derivative_of_its_cost(double):
    chi2 = jnp.asarray([0.0, 1.0, 16.7, 16.9, 40.0, 1e4, 1e8])
    kind, phi = jnp.full(7, LOOP), jnp.asarray(16.8)
    slope = jax.vmap(jax.grad(lambda x: robust(x[None], jnp.asarray([LOOP]), phi)[0][0]))(chi2)
    cost, weight = robust(chi2, kind, phi)
    np.testing.assert_allclose(2.0 * slope, weight, rtol=1e-9)
    assert (cost[:3] == 0.5 * chi2[:3]).all() and (cost <= 1.5 * phi).all() and (np.diff(cost) > 0).all()


def test_a_window_s_edges_and_an_infinite_kernel_are_quadratic(double):
    chi2 = jnp.asarray([0.0, 1e3, 1e6])
    for kind, phi in ((ODOMETRY, 16.8), (LOOP, np.inf)):
        cost, weight = robust(chi2, jnp.full(3, kind), jnp.asarray(phi))
        np.testing.assert_array_equal(cost, 0.5 * chi2)
        np.testing.assert_array_equal(weight, 1.0)


def test_a_step_is_a_right_perturbation(double):
    nodes = walk(3)
    steps = jnp.asarray(np.random.default_rng(0).normal(size=(3, 7)))
    moved = move(nodes, steps)
    np.testing.assert_allclose((nodes.T_world.inverse() @ moved.T_world).log(), steps[:, :6], atol=1e-12)
    np.testing.assert_array_equal(moved.log_scale, nodes.log_scale + steps[:, 6])


def test_edges_are_typed_by_rows():
    edges = measure(walk(3), [(0, 1)])
    with pytest.raises(Exception, match="sqrt_info|7"):
        Edges(edges.a, edges.b, edges.Z_a_b, edges.log_ratio, edges.sqrt_info[:, :6], edges.kind, edges.valid)
