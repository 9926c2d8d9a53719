"""The solver of the pose graph: known optima, symmetries, false loops, and graphs that it must refuse."""

from pathlib import Path

import hydra
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from g2o_reader import load_graph_g2o
from omegaconf import OmegaConf
from rings import (
    OFFSETS,
    STD,
    chain,
    config,
    disturb,
    error,
    exp,
    join,
    loop_pairs,
    matrices_of,
    measure,
    measure_loops,
    noisy_laps,
    poses_of,
    put,
    rmse,
    rows_of,
    walk,
    window_pairs,
    without_scale,
)
from scipy import stats

from emgs_jax.config.schema import schema_of
from emgs_jax.pose_graph.chordal import chordal_initialization
from emgs_jax.pose_graph.factors import Nodes, PoseGraph
from emgs_jax.pose_graph.optimize import PoseGraphConfig, optimize
from emgs_jax.pose_graph.problem import problem_of
from emgs_jax.pose_graph.sparse import damped_step, normal_equations

ROOT = Path(__file__).resolve().parents[2]
GRAPHS = ROOT.parent / "shared" / "data" / "graphs"
needs_graphs = pytest.mark.skipif(not GRAPHS.exists(), reason="the shared pose graphs are not here")


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def poses(nodes: Nodes) -> np.ndarray:
    """Poses with quaternions of one sign, and scales."""
    T, scales = np.asarray(nodes.T_world.wxyz_xyz), np.asarray(nodes.log_scale)
    return np.concatenate([T[:, :4] * np.sign(T[:, :1]), T[:, 4:], scales[:, None]], axis=1)


def in_float32(graph: PoseGraph) -> PoseGraph:
    numbers = lambda x: np.asarray(x, np.float32) if x.dtype == np.float64 else x  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(numbers(x)), graph)


def same(nodes: Nodes, others: Nodes) -> bool:
    return all((np.asarray(a) == np.asarray(b)).all() for a, b in zip(*map(jax.tree.leaves, (nodes, others))))  # noqa: B905


@needs_graphs
@pytest.mark.weekly  # thousands of nodes
@pytest.mark.parametrize("start", ["current", "chordal"])
@pytest.mark.parametrize(("name", "optimum"), [("sphere2500", 675.7010), ("parking-garage", 0.6342)])
def test_known_optima_are_reached(name, optimum, start):
    """½χ² by GTSAM 4.3.0."""
    _, info = optimize(load_graph_g2o(GRAPHS / f"{name}.g2o"), config(kernel=np.inf, start=start))
    assert info.converged and not info.reason
    assert info.cost == pytest.approx(optimum, rel=1e-3)


@pytest.mark.parametrize("start", ["current", "chordal"])
@pytest.mark.parametrize("scale_std", [0.0, np.inf])
def test_exact_measurements_give_the_truth(start, scale_std):
    """From poses off by .3 m and .3 rad, and scales by e^{±.3}."""
    truth = walk(30, laps=1.0, scale_std=0.3 * (scale_std > 0))
    edges = join(measure(truth, window_pairs(30)), measure_loops(truth, [(0, 29), (2, 28)]))
    given = disturb(truth, np.random.default_rng(1), np.array([0.3] * 6 + [0.3 * (scale_std > 0)]))
    nodes, info = optimize(PoseGraph(given, edges), config(scale_std=scale_std, start=start, kernel=np.inf))
    assert not info.reason and info.converged
    np.testing.assert_allclose(error(nodes, truth), 0.0, atol=1e-6)


def test_where_the_solver_starts_exact_measurements_have_no_error_left():
    """Rotations first, then positions, from any: two linear problems."""
    truth = walk(30, laps=1.0)
    edges = join(measure(truth, window_pairs(30)), measure_loops(truth, [(0, 29), (2, 28)]))
    given = disturb(truth, np.random.default_rng(1), np.array([0.3] * 6 + [0.0]))
    problem = problem_of(PoseGraph(given, edges), 0.0)
    nodes = rows_of(chordal_initialization(problem.graph, problem.free), np.arange(30))
    np.testing.assert_allclose(error(nodes, truth), 0.0, atol=1e-9)


def test_where_the_solver_starts_measurements_count_by_the_mean_of_their_information():
    """Of two steps that are measured differently: the mean position, and the angle of the mean rotation matrix."""
    nodes = put(walk(2), T_world=poses_of(np.tile(np.eye(4), (2, 1, 1))))
    steps, roots = np.array([[0.1, 0, 0, 0, 0, 0.2], [0.3, 0.2, 0, 0, 0, -0.1]]), np.random.default_rng(0)
    roots = roots.uniform(1.0, 9.0, (2, 7, 7)) * np.array([[1, 1, 1, 5, 1, 1, 1], [1, 1, 1, 1, 1, 9, 1]])[:, None]
    edges = put(measure(nodes, [(0, 1)] * 2), Z_a_b=poses_of(exp(steps)), sqrt_info=roots)
    problem = problem_of(PoseGraph(nodes, edges), 0.0)
    found = matrices_of(rows_of(chordal_initialization(problem.graph, problem.free).T_world, np.arange(2)))[1]
    information = np.einsum("erk,erk->ek", roots, roots)
    of_place, of_turn = (np.mean(information[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    turn = np.arctan2(of_turn @ np.sin(steps[:, 5]), of_turn @ np.cos(steps[:, 5]))
    np.testing.assert_allclose(found[:3, 3], of_place @ exp(steps)[:, :3, 3] / of_place.sum(), atol=1e-9)
    np.testing.assert_allclose(found[:3, :3], exp([[0, 0, 0, 0, 0, turn]])[0, :3, :3], atol=1e-9)


def test_there_is_no_such_start_where_nodes_are_turned_by_each_other_alone():
    nodes = put(walk(3), T_world=poses_of(np.tile(np.eye(4), (3, 1, 1))))
    edges = measure(nodes, window_pairs(3, (1,)))
    edges = put(edges, sqrt_info=lambda roots: roots * (np.arange(7) < [[[3]], [[7]]]))
    problem = problem_of(PoseGraph(nodes, edges), 0.0)
    assert chordal_initialization(problem.graph, problem.free) is None


def test_a_damped_step_is_that_of_dense_matrices():
    rng, ends = np.random.default_rng(0), np.array([[0, 1], [1, 2], [2, 0]])
    residuals, jacobians, prior = (rng.uniform(-1, 1, shape) for shape in ((3, 4, 1), (3, 4, 4), (3, 2, 2)))
    free, prior = np.array([[False, False], [True, True], [True, False]]), prior**2
    J = np.zeros((3, 4, 3, 2))
    for row, pair in enumerate(ends):
        J[row][:, pair] = jacobians[row].reshape(4, 2, 2)
    J, rows, (information, pull) = J.reshape(12, 6), free.ravel(), prior.reshape(6, 2).T
    H, g = J.T @ J + np.diag(information), J.T @ residuals.reshape(12) + pull
    H, expected = H[rows][:, rows], np.zeros(6)
    expected[rows] = -np.linalg.solve(H + 0.5 * np.diag(np.diag(H)), g[rows])
    found = damped_step(normal_equations(ends, residuals, jacobians, free, prior), 0.5)
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)


def test_a_loop_of_scale_alone_spreads_linearly():
    """Steps measure equal scales, the loop a ratio of e^{.3}, as exact as each of the ten steps: a share of 1/11."""
    nodes = walk(11)
    edges = join(measure(nodes, window_pairs(11, (1,))), measure_loops(nodes, [(0, 10)]))
    edges = put(edges, log_ratio=np.r_[np.zeros(10), 0.3], sqrt_info=lambda roots: roots * (np.arange(7) == 6)[:, None])
    found, info = optimize(PoseGraph(nodes, edges), config(scale_std=np.inf, kernel=np.inf))
    np.testing.assert_allclose(found.log_scale, 0.3 / 11 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(found.T_world.wxyz_xyz, nodes.T_world.wxyz_xyz, atol=1e-12)
    assert info.dof == 11 - 10


def test_the_scale_prior_pulls_to_the_map_s_scale():
    """One edge says σ = .3 ± .01, the prior 0 ± .01: half."""
    nodes = walk(2)
    edges = put(measure(nodes, [(0, 1)]), log_ratio=[0.3])
    found, info = optimize(PoseGraph(nodes, edges), config(scale_std=0.01))
    assert float(found.log_scale[1]) == pytest.approx(0.15, rel=1e-5)
    assert info.cost == pytest.approx(0.5 * 2 * 15**2, rel=1e-5)
    assert float(found.log_scale[0]) == 0.0


def test_scales_that_may_not_move_cost_nothing_wherever_they_are():
    nodes = put(walk(5), log_scale=np.full(5, 0.3))
    _, info = optimize(PoseGraph(nodes, measure(nodes, window_pairs(5, (1,)))), config(scale_std=0.0))
    assert info.cost_before == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def laps():
    """Truth, a noisy graph of two laps with free scales, its solution, and what was found."""
    with jax.enable_x64(True):
        rng, truth = np.random.default_rng(3), walk(40, scale_std=0.05)
        loops = measure_loops(truth, loop_pairs(40, 8), rng=rng)
        edges = join(measure(truth, window_pairs(40), rng=rng), loops)
        graph = PoseGraph(chain(truth, edges), edges)
        return truth, graph, *optimize(graph, config(scale_std=0.05))


MOVING, ORDER = exp([5.0, -3, 1, 0.3, 2.0, -0.4]), np.random.default_rng(0).permutation(len(window_pairs(40)) + 8)


def elsewhere(nodes: Nodes) -> Nodes:
    return put(nodes, T_world=poses_of(MOVING @ matrices_of(nodes.T_world)))


def twice_at_half(edges):
    half = put(edges, sqrt_info=lambda roots: roots / np.sqrt(2))
    return join(half, half)


@pytest.mark.parametrize(
    ("of_nodes", "of_edges"),
    [(elsewhere, None), (None, lambda edges: rows_of(edges, ORDER)), (None, twice_at_half)],
    ids=["another world frame", "another order of edges", "every edge twice at half its information"],
)
def test_what_says_the_same_gives_the_same(laps, of_nodes, of_edges):
    _, graph, found, info = laps
    of_nodes, of_edges = of_nodes or (lambda nodes: nodes), of_edges or (lambda edges: edges)
    again, other = optimize(PoseGraph(of_nodes(graph.nodes), of_edges(graph.factors)), config(scale_std=0.05))
    np.testing.assert_allclose(poses(again), poses(of_nodes(found)), atol=1e-6)
    assert other.cost == pytest.approx(info.cost, rel=1e-6)


def test_padding_is_not_looked_at_and_stays(laps):
    _, graph, found, info = laps
    fill = lambda x: np.full((3, *x.shape[1:]), np.nan if x.dtype == np.float64 else 0, x.dtype)  # noqa: E731
    filled = lambda part: join(part, jax.tree.map(fill, part))  # noqa: E731
    padded = PoseGraph(filled(graph.nodes), filled(graph.factors))
    again, other = optimize(padded, config(scale_std=0.05))
    np.testing.assert_array_equal(poses(again)[:-3], poses(found))
    assert (
        np.isnan(poses(again)[-3:]).all()
        and other.cost == info.cost
        and len(other.factor_chi2) == len(padded.factors.a)
    )
    np.testing.assert_array_equal(other.factor_chi2[-3:], 0.0)


def test_the_first_node_in_use_stays(laps):
    _, graph, found, _ = laps
    before = np.asarray(graph.nodes.T_world.wxyz_xyz)
    np.testing.assert_array_equal(np.asarray(found.T_world.wxyz_xyz)[0], before[0])
    later = PoseGraph(put(graph.nodes, valid=np.arange(40) > 0), graph.factors)
    again, _ = optimize(later, config(scale_std=0.05))
    for row, stays in ((0, True), (1, True), (2, False)):
        assert (np.asarray(again.T_world.wxyz_xyz)[row] == before[row]).all() == stays


def test_without_loops_a_chain_stays_bit_for_bit():
    """Also in float32, whose rounding leaves errors of its own."""
    truth = walk(40)
    edges = without_scale(measure(truth, window_pairs(40, (1,)), rng=np.random.default_rng(0)))
    graph = PoseGraph(chain(truth, edges), edges)
    single = in_float32(graph)
    for given in (graph, single):
        nodes, info = optimize(given, config(scale_std=0.05))
        assert same(nodes, given.nodes) and info.converged and not info.reason


def test_the_solution_is_not_moved_again(laps):
    _, graph, found, _ = laps
    again, info = optimize(PoseGraph(found, graph.factors), config(scale_std=0.05))
    assert info.converged and not info.reason
    np.testing.assert_allclose(poses(again), poses(found), atol=1e-7)


def test_float32_poses_are_solved_in_float64(laps):
    _, graph, found, info = laps
    single = in_float32(graph)
    with jax.enable_x64(False):
        nodes, other = optimize(single, config(scale_std=0.05))
        assert nodes.log_scale.dtype == jnp.float32
    assert other.cost == pytest.approx(info.cost, rel=1e-4)
    np.testing.assert_allclose(poses(nodes), poses(found), atol=1e-5)


def test_chi2_of_noisy_measurements_has_its_distribution():
    """Within the 99 % interval of its degrees of freedom, for the whole graph with scales and their prior."""
    rng, truth = np.random.default_rng(5), walk(60, scale_std=0.03)
    loops = measure_loops(truth, loop_pairs(60, 10), rng=rng)
    edges = join(measure(truth, window_pairs(60), rng=rng), loops)
    _, info = optimize(PoseGraph(chain(truth, edges), edges), config(scale_std=0.03, kernel=np.inf))
    low, high = stats.chi2.interval(0.99, info.dof)
    assert low < 2 * info.cost < high
    assert info.dof == 7 * edges.a.shape[0] + 59 - 7 * 59


def drifted(num_nodes: int, seed: int) -> tuple[Nodes, PoseGraph]:
    """Odometry five times as noisy as its loops, of which there are three: metres of drift."""
    rng, truth = np.random.default_rng(seed), walk(num_nodes)
    window = measure(truth, window_pairs(num_nodes), 5 * STD, rng)
    edges = without_scale(join(window, measure_loops(truth, loop_pairs(num_nodes, 3), STD, rng)))
    return truth, PoseGraph(chain(truth, edges), edges)


@pytest.mark.slow
def test_spreading_the_errors_first_keeps_true_loops_after_metres_of_drift():
    """From the chain itself the kernel refuses one of the three."""
    truth, graph = drifted(200, 0)
    given, stuck = optimize(graph, config(start="current"))
    found, info = optimize(graph, config(start="chordal"))
    assert rmse(graph.nodes, truth) > 1.0 and stuck.factor_weights[-3:].min() < 0.01
    assert info.factor_weights[-3:].min() > 0.99 and info.cost < stuck.cost - 10
    assert rmse(found, truth) < rmse(given, truth)


def stretched(num_nodes: int, seed: int) -> tuple[Nodes, PoseGraph]:
    """Odometry whose scale walks by 2 % a frame and that measures no change of it; three loops."""
    rng, truth = np.random.default_rng(seed), walk(num_nodes)
    scales = np.concatenate([[0.0], np.cumsum(0.02 * rng.normal(size=num_nodes - 1))])
    truth = put(truth, log_scale=scales)
    window = measure(truth, window_pairs(num_nodes), STD * np.where(np.arange(7) == 6, 2.0, 1.0), rng)
    window = put(window, log_ratio=lambda ratio: 0 * ratio)
    edges = join(window, measure_loops(truth, loop_pairs(num_nodes, 3), STD, rng))
    return truth, PoseGraph(chain(truth, edges), edges)


@pytest.mark.slow
def test_where_a_loop_would_be_left_out_the_search_begins_with_all_of_them_in_full_too():
    """Errors spread over poses know nothing of the scale: from there the kernel refuses true loops."""
    truth, graph = stretched(160, 2)
    _, stuck = optimize(graph, config(scale_std=np.inf, start="current"))
    found, info = optimize(graph, config(scale_std=np.inf))
    assert stuck.factor_weights[-3:].min() < 0.01
    assert info.factor_weights[-3:].min() > 0.99 and info.cost < stuck.cost - 10
    assert rmse(found, truth) < 0.05 < 0.4 < rmse(graph.nodes, truth)


def test_of_both_searches_the_cheaper_one_is_taken():
    """Here the one that begins with all loops in full ends at a hundred more."""
    _, graph = stretched(160, 0)
    costs = [optimize(graph, config(scale_std=np.inf, start=start))[1].cost for start in ("current", "chordal")]
    assert costs[1] <= costs[0] * (1 + 1e-9)


def test_without_damping_at_the_start_a_step_that_fails_is_damped():
    """0 stayed 0: the same step was tried until none was left. Oracle: the optimum as found from near the truth."""
    rng, truth = np.random.default_rng(0), walk(20, laps=1.0, scale_std=0.1)
    edges = join(measure(truth, window_pairs(20, (1, 2)), STD, rng), measure_loops(truth, [(0, 19), (1, 18)], STD, rng))
    free = {"start": "current", "kernel": np.inf, "max_iterations": 200, "scale_std": np.inf}
    far = disturb(truth, np.random.default_rng(1), np.array([3.0] * 3 + [1.5] * 3 + [1.0]))
    (_, best), (_, info) = (optimize(PoseGraph(given, edges), config(damping=0.0, **free)) for given in (truth, far))
    assert info.converged and not info.reason and info.cost == pytest.approx(best.cost, rel=1e-6)


def test_a_step_that_costs_more_is_not_taken():
    """From far away, undamped: more steps never cost more, and some of them are refused."""
    truth = walk(30, laps=1.0)
    graph = PoseGraph(disturb(truth, np.random.default_rng(0), np.full(7, 1.5)), measure(truth, window_pairs(30)))
    costs = [optimize(graph, config(start="current", max_iterations=count))[1].cost for count in range(9)]
    assert (np.diff(costs) <= 0).all() and (np.diff(costs) == 0).any() and costs[-1] < costs[0]


def test_parts_without_a_path_to_the_first_node_stay():
    truth, graph = noisy_laps(24, 6, 1)
    given = disturb(truth, np.random.default_rng(0), 0.1 * (np.arange(7) < 6))
    both = join(graph.nodes, given)
    there = put(graph.factors, a=lambda a: a + 24, b=lambda b: b + 24)
    bridge = put(measure_loops(both, [(3, 30)]), sqrt_info=np.zeros((1, 7, 7)))  # measures nothing
    nodes, info = optimize(PoseGraph(both, join(graph.factors, there, bridge)), config())
    alone, _ = optimize(graph, config())
    assert info.num_disconnected == 24
    np.testing.assert_allclose(poses(nodes)[:24], poses(alone), atol=1e-9)
    np.testing.assert_array_equal(poses(nodes)[24:], poses(given))


def refused(graph: PoseGraph, reason: str, **changes) -> None:
    nodes, info = optimize(graph, config(**changes))
    assert nodes is graph.nodes and reason in info.reason


def test_what_is_not_finite_is_refused_by_row():
    _, graph = noisy_laps(24, 6, 2)

    def spoilt(values, place, value):
        values = np.array(values)
        values[place] = value
        return jnp.asarray(values)

    nodes, edges = graph.nodes, graph.factors
    nowhere = jaxlie.SE3(spoilt(edges.Z_a_b.wxyz_xyz, (7, 2), np.nan))
    refused(PoseGraph(nodes, put(edges, Z_a_b=nowhere)), "[7]")
    refused(PoseGraph(nodes, put(edges, sqrt_info=spoilt(edges.sqrt_info, 3, np.inf))), "factors [3]")
    refused(PoseGraph(put(nodes, log_scale=spoilt(nodes.log_scale, 5, np.nan)), edges), "nodes [5]")
    refused(PoseGraph(put(nodes, log_scale=spoilt(nodes.log_scale, 5, -1e3)), edges), "cost")
    refused(PoseGraph(nodes, put(edges, valid=np.zeros(edges.a.shape, bool))), "no factor")
    alone = (np.asarray(edges.a) != 0) & (np.asarray(edges.b) != 0)
    refused(PoseGraph(nodes, put(edges, valid=alone)), "no measurement leads to the first node")


def test_loops_that_contradict_the_window_are_refused_or_given_no_weight():
    """Two loops between the same poses, metres apart: the kernel lets neither count; without it nothing moves."""
    truth = walk(24)
    window = measure(truth, window_pairs(24), rng=np.random.default_rng(0))
    loops = measure_loops(truth, [(0, 12), (0, 12)])
    apart = matrices_of(loops.Z_a_b) @ exp([[3.0, 0, 0, 0, 0, 0], [-3.0, 0, 0, 0, 0, 0]])
    loops = put(loops, Z_a_b=poses_of(apart))
    graph = PoseGraph(chain(truth, window), without_scale(join(window, loops)))
    one = PoseGraph(graph.nodes, put(graph.factors, valid=np.arange(len(graph.factors.a)) < len(graph.factors.a) - 1))
    refused(one, "contradict", kernel=np.inf, max_misfit=25.0)
    for given in (one, graph):
        _, info = optimize(given, config(max_misfit=25.0))
        assert not info.reason and (info.factor_weights[-2:] < 0.2)[np.asarray(given.factors.valid)[-2:]].all()


def test_the_solver_of_conf_is_a_config_and_without_iterations_nothing_moves():
    _, graph = noisy_laps(24, 6, 4)
    default = OmegaConf.create(schema_of("graph/schema")).solver
    on, off = (hydra.utils.instantiate(default, **changes) for changes in ({}, {"max_iterations": 0}))
    assert isinstance(on, PoseGraphConfig) and rmse(optimize(graph, on)[0], graph.nodes) > 0.01
    assert same(optimize(graph, off)[0], graph.nodes)
    (_, end), (_, stopped) = optimize(graph, on), optimize(graph, hydra.utils.instantiate(default, max_iterations=1))
    assert end.converged is True and stopped.converged is False and stopped.num_iterations == 1 < end.num_iterations
    with pytest.raises(hydra.errors.InstantiationException, match="one of current, chordal"):
        hydra.utils.instantiate(default, start="spread")


def test_growing_graphs_share_executables():
    from emgs_jax.pose_graph import problem

    truth = walk(60, laps=1.0)
    for count in (40, 47, 60):
        nodes = rows_of(truth, slice(count))
        edges = measure(nodes, window_pairs(count, OFFSETS[:3]), std=STD, rng=np.random.default_rng(0))
        optimize(PoseGraph(nodes, edges), config(max_iterations=2, start="current"))
        if count == 40:
            compiled = problem._linearize._cache_size()
    assert problem._linearize._cache_size() <= compiled + 1  # edges pass 128 once
