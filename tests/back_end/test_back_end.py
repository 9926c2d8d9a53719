"""Measurements of a walk on a ring, exact: nothing moves; after a drift one loop brings poses and map back."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scene import assert_same, device, random_gaussians, random_observation

from emgs_jax import back_end, load_config
from emgs_jax.back_end.factors import (
    Factor,
    FrameData,
    chi2,
    map_factor,
    sequential_factor,
    stack_factors,
    window_factor,
    with_disagreement,
)
from emgs_jax.back_end.loops import (
    consistent_loops,
    detect_loops,
    is_closure_due,
    not_in_graph,
    query_prior,
    remove_inconsistent,
    violated,
)
from emgs_jax.back_end.optimization import (
    close_loops,
    deform_state,
    depth_noise_of,
    follow_prior,
    merge_duplicates_of_state,
    nodes_of,
    one_layer_of_state,
)
from emgs_jax.back_end.state import BackEnd, Node, add_node, transform_nodes
from emgs_jax.data.images import Images
from emgs_jax.device.arrays import to_se3
from emgs_jax.device.clock import Clock
from emgs_jax.gaussian_map import new_map
from emgs_jax.geometry import Sim3, scale_pose
from emgs_jax.loop_closure.place_recognition import Database, Keyframe
from emgs_jax.loop_closure.prior_query import JointPrediction
from emgs_jax.loop_closure.two_view_alignment import Gate
from emgs_jax.loop_closure.verification import LoopMeasurement, VerifyInfo
from emgs_jax.mapping import integrate
from emgs_jax.mapping.atlas import Atlas, Submap, World
from emgs_jax.mapping.event import Event
from emgs_jax.mapping.integrate import finish_back_end, update_graph
from emgs_jax.mapping.window_input import WindowInput, make_prior_query
from emgs_jax.motion import no_looks
from emgs_jax.pose_graph.deform import DeformConfig
from emgs_jax.pose_graph.factors import PoseGraph, residuals
from emgs_jax.prior.files.prior import Files
from emgs_jax.prior.files.stream import Stream
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.report.page_words import loop_why
from emgs_jax.runs import back_end as report
from emgs_jax.runs.back_end import counts, found_loops, loop_list, metric_graph, revisit_note
from emgs_jax.slam import SlamState

COUNT, WINDOW = 60, 10


@pytest.fixture(scope="module")
def graph():
    return load_config("graph=default").graph


def ring(turn: float = 2 * np.pi) -> np.ndarray:
    """Camera poses (n, 4, 4) along a ring of 2 m that the last one closes; less than a turn drifts."""
    return on_ring(turn * np.arange(COUNT) / (COUNT - 1))


def on_ring(angles: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = 2 * np.sin(angle), 0, 2 * np.cos(angle) - 2
    return poses


def look(poses: np.ndarray, index: int, frame: int | None = None) -> FrameData:
    views = {0: poses[0]} | {i: poses[i] for i in range(max(index - WINDOW, 0), min(index + 2, COUNT))}
    views = {i: np.linalg.inv(poses[0]) @ pose for i, pose in views.items()}
    empty = np.zeros((4, 4, 3))
    return FrameData(index if frame is None else frame, np.uint8(empty), empty, np.zeros((4, 4), bool), views)


def state_of(poses: np.ndarray) -> SlamState:
    """A Gaussian in front of every camera, born with it."""
    gaussians = random_gaussians(COUNT)
    means = jnp.asarray([pose[:3, :3] @ [0, 0, 1.5] + pose[:3, 3] for pose in poses], jnp.float32)
    gaussians = eqx.tree_at(lambda g: g.means, gaussians, means)
    map = new_map(gaussians, jnp.ones(COUNT), jnp.ones(()), jnp.asarray(0))
    map = eqx.tree_at(lambda m: m.birth, map, jnp.arange(COUNT, dtype=jnp.int32))
    last = jaxlie.SE3.from_matrix(jnp.asarray(poses[-1], jnp.float32))
    return SlamState(map, random_observation(20), last, exact_estimate(), jnp.asarray(COUNT))


def walked(graph, poses: np.ndarray, scale: float = 1.0) -> BackEnd:
    end = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01)
    for index, pose in enumerate(poses):
        end = add_node(end, look(poses, index), pose, scale, max(index - 3, 0))
    return end


def atlas_of(end: BackEnd, state: SlamState) -> Atlas:
    return Atlas(None, load_config().slam, end, {0: Submap(state)})


def changed(end: BackEnd, **columns) -> BackEnd:
    """Other values of some fields of all nodes."""
    rows = zip(end.nodes, *columns.values(), strict=True)
    return replace(end, nodes=[replace(node, **dict(zip(columns, values, strict=True))) for node, *values in rows])


def loop(poses: np.ndarray, row: int = 1) -> LoopMeasurement:
    Z = np.linalg.inv(poses[row]) @ poses[-row - 1]
    return LoopMeasurement(row, COUNT - row - 1, Z, 0.0, np.diag([100.0] * 3 + [200.0] * 3 + [100.0]), 50)


def error(poses, truth) -> float:
    return max(np.linalg.norm(pose[:3, 3] - true[:3, 3]) for pose, true in zip(poses, truth, strict=True))


def test_what_was_measured_without_error_moves_nothing(graph):
    poses = ring()
    end, state = walked(graph, poses), state_of(poses)
    end, closed = close_loops(end, state, [loop(poses)])
    assert error(end.poses, poses) < 1e-5 and end.closures[-1].info.reason == ""
    np.testing.assert_allclose(closed.map.gaussians.means, state.map.gaussians.means, atol=1e-5)
    assert chi2(loop(poses), end.poses, end.log_scales) < 1e-3 and not is_closure_due(end, [loop(poses)])


def test_a_loop_brings_poses_map_and_last_frame_back(graph):
    """Each Gaussian with its own camera: they are 20 cm apart, no surface that must not be torn."""
    graph = replace(graph, deform=DeformConfig(num_neighbours=1, max_gap=0))
    truth, drifted = ring(), ring(1.95 * np.pi)
    end = walked(graph, drifted)
    state = state_of(drifted)
    loops = [loop(truth, row) for row in range(1, 9)]
    assert chi2(loops[0], end.poses, end.log_scales) > graph.min_violation and is_closure_due(end, loops)
    before, gap = error(drifted, truth), lambda poses: np.linalg.norm(poses[1][:3, 3] - poses[-2][:3, 3])
    end, closed = close_loops(end, state, loops)
    assert end.accepted == loops and not is_closure_due(end, loops)
    np.testing.assert_allclose(gap(end.poses), gap(truth), atol=0.02)
    assert error(end.poses, truth) < 0.5 * before
    for node, mean in zip(end.nodes, closed.map.gaussians.means, strict=True):
        seen = np.array([0, 0, 1.5 * np.exp(node.log_scale), 1])
        np.testing.assert_allclose(mean, (node.pose @ seen)[:3], atol=1e-4)
    np.testing.assert_allclose(closed.T_world_previous.as_matrix(), end.poses[-1], atol=1e-5)
    assert error([node.online for node in end.nodes], drifted) == 0


def test_the_mean_of_the_scales_that_the_unit_of_a_run_is_made_of_follows_a_closure(graph):
    """Inferences that are all 5 % too small: what the closure grows of the map, a finished run must not grow again."""
    poses, log_scale = ring(), 0.05
    end = walked(graph, poses, np.exp(log_scale))
    state = eqx.tree_at(lambda s: s.estimate.log_scale, state_of(poses), jnp.asarray(log_scale))
    smaller = np.stack([scale_pose(pose, 0.9) for pose in poses])
    end = replace(end, verified=[loop(smaller, row) for row in range(1, 9)])
    atlas = finish_back_end(atlas_of(end, state))
    end = atlas.graph
    assert end.accepted and log_scale - np.mean(end.log_scales) > 1e-3  # `scale_std` asks for scales of one
    assert float(atlas.state.estimate.log_scale) == pytest.approx(np.mean(end.log_scales), abs=1e-5)


def test_what_earlier_frames_looked_through_grows_with_the_map(graph):
    """Oracle: points of a look, about the last camera. Else a map that shrinks stands in its own free space."""
    poses, factor = ring(), 0.8
    end = walked(graph, poses)
    before = nodes_of(end)
    after = nodes_of(transform_nodes(end, range(COUNT), Sim3.about(poses[0][:3, 3], factor)))
    depth, motions = np.linspace(1, 3, 80).reshape(2, 2, 20), np.linalg.inv(poses[-1]) @ poses[-3:-1]
    points = np.linspace(0, 2, 120).reshape(2, 20, 3)
    nothing = no_looks(random_observation(20), load_config("slam.motion.num_looks=2").slam.motion)
    looks = replace(nothing, points=device(points), depth=device(depth), T_previous_look=to_se3(motions))
    state = replace(state_of(poses), looks=looks)
    found = deform_state(state, before, after, 0.01, graph.deform).looks
    np.testing.assert_allclose(found.depth, factor * depth, rtol=1e-6)
    np.testing.assert_allclose(found.points, factor * points, rtol=1e-6)
    expected = np.stack([scale_pose(motion, factor) for motion in motions])
    np.testing.assert_allclose(found.T_previous_look.as_matrix(), expected, atol=1e-6)
    assert_same(deform_state(state, before, before, 0.01, graph.deform).looks, looks)


def test_loops_that_are_contradicted_later_are_no_edges_any_more(graph):
    truth, drifted = ring(), ring(1.95 * np.pi)
    end, loops = walked(graph, drifted), [loop(truth, row) for row in range(1, 9)]
    end = replace(end, verified=list(loops))
    assert not_in_graph(end, consistent_loops(end)) == loops
    end, _ = close_loops(end, state_of(drifted), loops)
    assert len(remove_inconsistent(end).accepted) == len(end.accepted) == len(loops)
    assert not_in_graph(end, consistent_loops(end)) == []
    end = replace(end, violating=[loop(truth, row) for row in (9, 10)])
    num_edges = len(end.factors)
    end = remove_inconsistent(end)
    assert not end.accepted and len(end.factors) == num_edges - len(loops)


def test_what_is_contradicted_on_the_way_is_taken_back_at_once(graph, monkeypatch):
    truth, drifted = ring(), ring(1.95 * np.pi)
    end, loops = walked(graph, drifted), [loop(truth, row) for row in range(1, 9)]
    end = replace(end, verified=list(loops))
    end, state = close_loops(end, state_of(drifted), loops)
    before, motion = end.nodes[-1].pose, jaxlie.SE3.from_matrix(jnp.asarray(ring()[7], jnp.float32))
    atlas = replace(atlas_of(end, state), world=World(motion=motion))
    frame, raw = SimpleNamespace(index=COUNT - 1, image=None), SimpleNamespace(points=None, mask=None)
    given = WindowInput((frame,), (raw,), None, None, {}, {}), Event(np.eye(4)[None])
    monkeypatch.setattr(integrate, "add_node", lambda end, *arguments: end)
    monkeypatch.setattr(integrate, "detect_loops", lambda end, frame: end)
    atlas = update_graph(atlas, *given)
    assert atlas.graph.accepted == loops and len(atlas.graph.closures) == 1 and atlas.world.motion is motion

    def contradict(end: BackEnd, frame: FrameData) -> BackEnd:
        return replace(end, violating=[loop(truth, row) for row in (9, 10)])

    monkeypatch.setattr(integrate, "detect_loops", contradict)
    atlas = update_graph(atlas, *given)
    end = atlas.graph
    assert not end.accepted and len(end.closures) == 2
    assert error(end.poses, drifted) < 0.01
    # What the prior says of the next frame is as far from this one as before.
    change = end.poses[-1] @ np.linalg.inv(before)
    assert np.linalg.norm(change[:3, 3]) > 1e-3
    np.testing.assert_allclose(atlas.world.motion.as_matrix(), change @ motion.as_matrix(), atol=1e-5)


def test_a_loop_that_cannot_be_solved_changes_nothing(graph):
    poses = ring()
    end, state = walked(graph, poses), state_of(poses)
    broken = loop(poses)
    broken.Z_a_b[0, 3] = np.nan
    end, same = close_loops(end, state, [broken])
    assert_same(same, state)
    assert not end.accepted and end.closures[-1].info.reason and error(end.poses, poses) == 0
    assert counts(end)["loops/closures_refused"] == 1


def test_a_loop_that_others_agree_with_and_that_cannot_be_solved_says_why(graph, monkeypatch):
    """The page called it known, as if the poses had said so already."""
    poses = ring()
    end, state = walked(graph, poses), state_of(poses)
    known, broken = loop(poses), loop(poses)
    broken = replace(broken, b=broken.b - 1)
    end = replace(end, verified=[known, broken])
    monkeypatch.setattr(report, "consistent_loops", lambda end: end.verified)
    assert [line["outcome"] for line in loop_list(end)] == ["known", "known"]
    assert found_loops(end) == [known, broken], "what the poses say already is found as well"
    bad = replace(broken, Z_a_b=np.full((4, 4), np.nan))
    end, _ = close_loops(end, state, [bad])
    unsolved, other = loop_list(end)
    assert (unsolved["outcome"], other["outcome"]) == ("unsolved", "known")
    assert found_loops(end) == [known]
    end = replace(end, accepted=[known])
    assert found_loops(end) == [known], "once"
    assert unsolved["reason"] == end.closures[-1].info.reason and "reason" not in other
    assert loop_why(unsolved) == f"verified, but no better poses were found with it: {unsolved['reason']}"


def test_the_loops_of_a_map_that_was_loaded_do_not_count(graph):
    poses = ring()
    end = walked(graph, poses)
    old, new = replace(loop(poses), b=10), loop(poses)
    end = replace(end, verified=[old, new], accepted=[old, new], violating=[old], first_node=20)
    found = counts(end)
    assert (found["loops/verified"], found["loops/accepted"], found["loops/contradicted"]) == (1, 1, 0)


def test_a_frame_is_held_where_it_was_placed_and_not_where_it_was_predicted(graph):
    """Both edges, in the unit of the frame's inference, whatever the window says of the two frames."""
    placed, scales = list(ring(1.95 * np.pi)[:31]), [0.0] * 30 + [np.log(1.1)]
    chain = sequential_factor(look(ring(), 30), placed, scales, anywhere, graph.noise)
    held = map_factor(look(ring(), 30), placed, scales, 12, graph.noise)
    assert (chain.a, chain.b, held.a, held.b) == (30, 29, 30, 12)
    for edge in (chain, held):
        expected = np.linalg.inv(placed[30]) @ placed[edge.b]
        expected[:3, 3] /= 1.1
        np.testing.assert_allclose(edge.Z_a_b, expected, atol=1e-12)
    assert chain.log_ratio == pytest.approx(-np.log(1.1)) and held.sqrt_info[6, 6] == 0


def anywhere(row: int) -> bool:
    return True


def test_a_frame_is_not_measured_to_one_whose_pose_only_stands_in(graph):
    """The prior has lost two frames; its later answer, which knows them again, leads from before to after them."""
    end, poses = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01), ring()
    for frame in range(4):
        seen = look(poses, frame)
        if frame in (1, 2):
            seen.T_anchor_views[frame][:] = np.nan
        end = add_node(end, seen, poses[frame], 1.0, None, is_placed=frame == 0)
    assert [(edge.a, edge.b) for edge in end.factors] == [(3, 0)]
    end = add_node(end, look(poses, 4), poses[4], 1.0, None, is_placed=False)
    assert (end.factors[-1].a, end.factors[-1].b) == (4, 3), "a frame that is led to is as good as a placed one"


def test_the_frame_before_is_the_nearest_that_the_window_knows(graph):
    poses, scales = list(ring()[:31]), [0.0] * 31
    measured = look(ring(), 30)
    next_to = sequential_factor(measured, poses, scales, anywhere, graph.noise)
    for frame in (29, 28):
        measured.T_anchor_views[frame][:] = np.nan
    edge = sequential_factor(measured, poses, scales, anywhere, graph.noise)
    assert edge.b == 27
    np.testing.assert_allclose(edge.sqrt_info * np.sqrt(3), next_to.sqrt_info)
    assert sequential_factor(measured, poses, scales, lambda row: row >= 28, graph.noise) is None, (
        "before that the camera was lost"
    )
    measured.T_anchor_views[30][:] = np.nan
    assert sequential_factor(measured, poses, scales, anywhere, graph.noise) is None, "it is not known itself"


def test_what_is_measured_is_as_sure_as_the_depths_that_it_was_measured_by(graph):
    """Rotation by ν, translation by ν times the median depth in the unit of the inference, whatever that unit is."""
    poses, scales = list(ring()[:31]), [0.0] * 31
    blind = look(ring(), 30)
    seeing = replace(blind, points=np.full((4, 4, 3), 7.0), mask=np.arange(16).reshape(4, 4) < 3, depth_noise=0.02)
    seeing.points[0, :3, 2] = 2.0, 2.5, 40.0
    for edge, share in (
        (sequential_factor(seeing, poses, scales, anywhere, graph.noise), graph.noise.pair),
        (map_factor(seeing, poses, scales, 12, graph.noise), graph.noise.map),
    ):
        stds = 0.02 * share * np.array([2.5, 2.5, 2.5, 1, 1, 1])
        np.testing.assert_allclose(1 / np.diag(edge.sqrt_info)[:6], stds)
    assert sequential_factor(seeing, poses, scales, anywhere, graph.noise).sqrt_info[6, 6] == 1 / (
        0.02 * graph.noise.log_scale
    )
    exact = map_factor(replace(seeing, depth_noise=0.0), poses, scales, 12, graph.noise)
    assert 1e3 < exact.sqrt_info[0, 0] < 1e5, "more certain than any loop, and finite"
    first = map_factor(blind, poses, scales, 12, graph.noise)
    np.testing.assert_allclose(1 / np.diag(first.sqrt_info)[:6], graph.noise.depth * graph.noise.map)


def test_a_frame_that_comes_back_is_also_measured_over_its_window_as_the_prior_predicted(graph):
    """In the unit of its inference; its own path says nothing of what the earlier visit got wrong."""
    placed, scales = list(ring(1.98 * np.pi)[:51]), [0.0] * 50 + [np.log(1.1)]
    edge = window_factor(look(ring(), 50), placed, scales, anywhere, graph.noise, (40, np.inf))
    assert (edge.a, edge.b) == (50, 40) and not edge.is_loop, "the earliest view of its window, but not the anchor"
    np.testing.assert_allclose(edge.Z_a_b, np.linalg.inv(ring()[50]) @ ring()[40], atol=1e-12)
    chain = sequential_factor(look(ring(), 50), placed, scales, anywhere, graph.noise)
    np.testing.assert_allclose(edge.sqrt_info[:6, :6] * np.sqrt(10), chain.sqrt_info[:6, :6])
    assert edge.sqrt_info[6, 6] == 0, "one inference has one scale"


def test_a_window_leads_to_what_is_placed_and_not_far_from_where_a_frame_was_estimated(graph):
    poses, scales, seen = list(ring()[:51]), [0.0] * 51, look(ring(), 50)
    assert window_factor(seen, poses, scales, lambda row: row >= 44, graph.noise, (40, np.inf)).b == 44
    assert window_factor(seen, poses, scales, lambda row: row == 0, graph.noise, (40, np.inf)) is None
    assert window_factor(seen, poses, scales, lambda row: row == 0, graph.noise, (50, np.inf)).b == 0
    seen.T_anchor_views[40][:] = np.nan
    assert window_factor(seen, poses, scales, anywhere, graph.noise, (40, np.inf)).b == 41, "the prior knows no 40"
    off = list(ring(1.9 * np.pi)[:51])
    misfit = chi2(window_factor(seen, off, scales, anywhere, graph.noise, (40, np.inf)), off, scales)
    assert misfit > 0.1
    for share, is_kept in ((0.99, False), (1.01, True)):
        edge = window_factor(seen, off, scales, anywhere, graph.noise, (40, share * misfit))
        assert (edge is not None) == is_kept
    seen.T_anchor_views[50][:] = np.nan
    assert window_factor(seen, poses, scales, anywhere, graph.noise, (40, np.inf)) is None, "it is not known itself"


@pytest.mark.parametrize(("origin", "count"), [(None, 1), (49, 2), (10, 2), (9, 3)])
def test_only_a_frame_that_comes_back_has_a_window_factor(graph, origin, count):
    """The visit before ends 40 nodes before it, as in the deformation of the map."""
    poses, before = ring(), BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01)
    for index in range(50):
        before = add_node(before, look(poses, index), poses[index], 1.0, None)
    after = add_node(before, look(poses, 50), poses[50], 1.0, origin)
    assert len(after.factors) - len(before.factors) == count


def test_a_path_that_repeats_the_errors_of_an_earlier_visit_gains_by_what_its_windows_say(graph):
    """Both laps are estimated alike, too fast at first and too slow then; a loop that fits moves nothing by itself."""
    lap, end = COUNT - 1, BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01)
    angles = 2 * np.pi * np.arange(2 * lap) / lap
    truth, placed = on_ring(angles), on_ring(angles + 0.015 * np.sin(angles))
    for index, pose in enumerate(placed):
        views = {row: truth[row] for row in range(max(index - WINDOW, 0), index + 1)}
        seen = replace(look(ring(), 0, index), T_anchor_views=views)
        end = add_node(end, seen, pose, 1.0, index - lap if index >= lap else max(index - 1, 0))
    without = replace(end, factors=[one for one in end.factors if one.a - one.b != WINDOW])
    assert len(end.factors) - len(without.factors) == lap
    closing = LoopMeasurement(0, lap, np.eye(4), 0.0, np.diag([100.0] * 3 + [200.0] * 3 + [0.0]), 50)

    def farthest(end: BackEnd) -> float:
        solved, _ = close_loops(end, state_of(placed[:COUNT]), [closing])
        return float(np.linalg.norm(np.stack(solved.poses)[:, :3, 3] - truth[:, :3, 3], axis=1).max())

    assert farthest(without) == pytest.approx(0.03, rel=0.01) and farthest(end) < 0.8 * 0.03


def test_without_a_loop_nothing_moves_however_the_predictions_differ(graph):
    """With the window's own poses as edges the solution of a walk was of the raw prior's, and every surface rough."""
    placed = ring(1.95 * np.pi)
    end = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01)
    for index, pose in enumerate(placed):
        end = add_node(end, look(ring(), index), pose, 1.0, max(index - 3, 0))
    state = state_of(placed)
    assert_same(close_loops(end, state)[1].map, state.map)


def test_a_graph_for_other_solvers_costs_what_ours_does_and_has_the_nodes_of_the_map_only(graph):
    poses = ring()
    end = walked(graph, poses, scale=2.0)
    end = changed(end, pose=[pose @ change for pose, change in zip(end.poses, random_steps(0.01), strict=True)])
    ours = np.sum(residuals(PoseGraph(nodes_of(end), stack_factors(end.factors))) ** 2, axis=1)[: len(end.factors)]
    assert ours.min() > 0
    np.testing.assert_allclose(np.sum(residuals(metric_graph(end)) ** 2, axis=1)[: len(ours)], ours, rtol=1e-3)
    end = changed(end, submap=[-1] * 5 + [0] * (COUNT - 5))
    np.testing.assert_array_equal(np.flatnonzero(metric_graph(end).nodes.valid), range(5, COUNT))


def random_steps(std: float) -> np.ndarray:
    steps = np.random.default_rng(0).normal(0, std, (COUNT, 6))
    return np.asarray(jaxlie.SE3.exp(jnp.asarray(steps, jnp.float32)).as_matrix(), np.float64)


def told_again(poses: np.ndarray, off: float = 0.0):
    """A prior that knows the true poses, or one of another place `off` m away; and which frames it was asked for."""
    calls = []

    def ask(a: int, b: int) -> JointPrediction:
        calls.append((a, b))
        T = np.linalg.inv(poses[a]) @ poses[b]
        T[0, 3] += off
        points = np.float32(np.dstack([np.zeros((48, 64, 2)), np.full((48, 64), 2.0)]))
        return JointPrediction(T, (points, points), (np.ones((48, 64), bool),) * 2)

    return ask, calls


def with_keyframes(end: BackEnd) -> BackEnd:
    """All nodes are keyframes that show a wall 2 m away."""
    none = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32)
    wall = np.full((60, 80), 2.0, np.float32)
    keyframes = tuple(Keyframe(row, *none, end.intrinsics, (64, 48), wall) for row in range(len(end.poses)))
    return replace(end, database=Database(keyframes))


def test_a_place_where_a_map_begins_is_confirmed_by_the_two_keyframes_after_it(graph, monkeypatch):
    """The frame that opens the map is no keyframe, and beside the second one there are none before it."""
    asked, nothing = [], np.zeros((4, 4, 3), np.uint8)

    def note(query, candidate, neighbours, config):
        asked.append((query.frame, candidate.frame, [one.keyframe.frame for one in neighbours]))
        return None, VerifyInfo(Gate.MATCHES, 0.0)

    monkeypatch.setattr(back_end.loops, "verify", note)
    monkeypatch.setattr(back_end.loops, "propose_candidates", lambda database, row, config: [*range(row - 2)])
    end, poses = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01), ring()
    for index in range(7):
        seen = replace(look(poses, index), image=nothing)
        end = detect_loops(add_node(end, seen, poses[index], 1.0, None), seen)
    assert [one.frame for one in end.database.keyframes] == [*range(1, 7)]
    assert asked[-3:] == [(6, 1, [2, 3]), (6, 2, [1, 3]), (6, 3, [2, 4])]


@pytest.fixture
def drifted(graph) -> BackEnd:
    """A walk of keyframes with a drift, and four loops that are right."""
    end = with_keyframes(walked(graph, ring(1.95 * np.pi)))
    return replace(end, verified=[loop(ring(), row) for row in range(1, 5)])


def test_a_loop_that_the_prior_sees_too_is_more_certain_and_asked_for_once(drifted):
    end = changed(drifted, frame=[100 + row for row in range(COUNT)])  # numbers of the data set
    ask, calls = told_again(np.concatenate([np.tile(np.eye(4), (100, 1, 1)), ring()]))
    loops = list(end.verified)
    end = query_prior(end, loops[:2], ask)
    assert calls == [(101, 158), (102, 157)] and counts(end)["loops/measured_again"] == 2
    for before, now in zip(loops[:2], end.verified[:2], strict=True):
        np.testing.assert_allclose(now.Z_a_b, before.Z_a_b, atol=1e-6)
        assert (np.diag(now.sqrt_info) > np.diag(before.sqrt_info)).all()
    end = query_prior(end, end.verified, ask)
    assert len(calls) == 4 and len(end.verified) == 4 and revisit_note(end) == []


def test_of_a_closure_the_loops_with_most_inliers_are_asked_for(graph, drifted):
    truth = ring()
    end = replace(drifted, verified=[replace(loop(truth, row), num_inliers=40 + 10 * (row % 3)) for row in range(1, 7)])
    ask, calls = told_again(truth)
    end = query_prior(end, end.verified, ask)
    assert [a for a, _ in calls] == [2, 5, 1] and graph.prior_query.max_queries == 3
    end = replace(end, queries={})
    calls.clear()
    same = [replace(one, b=50, num_inliers=40 + one.a) for one in end.verified]  # all of one query: one witness
    end = replace(end, verified=list(same))
    end = query_prior(end, same, ask)
    assert len(calls) == 1 and calls[0][0] == 6


def test_what_is_known_already_takes_nobodys_turn(graph):
    """Four loops that the poses fit, with more inliers, were asked for, and a false one with less moved the poses."""
    poses = ring()
    end = with_keyframes(walked(graph, poses))
    known = [replace(loop(poses, row), num_inliers=90) for row in range(1, 5)]
    false = [replace(loop(ring(1.9 * np.pi), row), num_inliers=40) for row in range(5, 9)]
    end = replace(end, verified=[*known, *false])
    ask, calls = told_again(poses)
    end = query_prior(end, violated(end, not_in_graph(end, end.verified)), ask)
    assert sorted(a for a, _ in calls) == [5, 6, 7] and end.accepted == []
    assert [one.a for one in violated(end, end.verified)] == [8], "asked for, the prior says what the poses say"


@pytest.mark.parametrize("kind", ["files", "stream"])
def test_loops_that_correct_the_path_of_given_poses_close(graph, kind, tmp_path):
    """Symptom: prior=files answered with the drifted poses of its own path, and every true loop was refused."""
    truth, drifted = ring(), ring(1.95 * np.pi)
    (tmp_path / "images").mkdir()
    (tmp_path / "files").mkdir()
    folder = tmp_path / ("files" if kind == "files" else "images")
    for row, pose in enumerate(drifted):
        cv2.imwrite(str(tmp_path / "images" / f"{row:02}.png"), np.zeros((48, 64, 3), np.uint8))
        np.savez(folder / f"{row:02}.npz", depth=np.full((48, 64), 2.0), T_world_camera=pose)
    images = Images(str(tmp_path / "images"), intrinsics=[60.0, 60.0, 31.5, 23.5], size=(64, 48))
    keys = {"scale": "metric", "median_depth": 2.0, "depth_scale": 1000.0, "max_depth_step": 0.03, "pose_std": None}
    prior = Files(folder, **keys, max_misfit=10.0) if kind == "files" else Stream()
    prior.check(images, WINDOW)
    ask = make_prior_query(prior, images, graph.prior_query.spacing, WINDOW, Clock())
    end = replace(with_keyframes(walked(graph, drifted)), verified=[loop(truth, row) for row in range(1, 9)])
    end = finish_back_end(atlas_of(end, state_of(drifted)), ask).graph
    assert len(end.accepted) == 8 and not end.refusals
    assert error(end.poses, truth) < 0.5 * error(drifted, truth)


def walked_by(graph, poses: np.ndarray, predicted: np.ndarray, **known) -> BackEnd:
    """A walk with exact depths: each frame registered to the one three before it."""
    end = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01)
    for index, pose in enumerate(poses):
        frame = replace(look(predicted, index), depth_noise=0.002 if index else None, **known)
        end = add_node(end, frame, pose, 1.0, max(index - 3, 0))
    return end


def test_exact_depths_do_not_make_a_path_sure_that_odometry_contradicts(graph):
    """Symptom: true loops were accepted and hardly moved the poses, which were as sure as the depths were exact."""
    truth, placed, odometry = ring(), ring(1.95 * np.pi), ring(2.05 * np.pi)
    loops = [loop(truth, row) for row in range(1, 9)]
    end, _ = close_loops(walked_by(graph, placed, odometry), state_of(placed), loops)
    assert len(end.accepted) == 8 and error(end.poses, truth) < 0.5 * error(placed, truth)
    as_sure, _ = close_loops(walked_by(graph, placed, placed), state_of(placed), loops)
    assert error(as_sure.poses, truth) > 0.8 * error(placed, truth), "odometry and map agree"


def test_what_map_and_odometry_differ_by_is_a_factors_error(graph):
    """In units of depth and rad, the mean over six axes; a scale is not compared."""
    placed, odometry = ring(), ring(2.05 * np.pi)
    end, same = walked_by(graph, placed, odometry), walked_by(graph, placed, placed)
    for factor, other in zip(end.factors[-2:], same.factors[-2:], strict=True):
        off = np.linalg.inv(np.linalg.inv(odometry[factor.a]) @ odometry[factor.b])
        off = off @ np.linalg.inv(placed[factor.a]) @ placed[factor.b]
        turn = 0.05 * np.pi / (COUNT - 1) * (factor.a - factor.b)
        added = (np.sum(off[:3, 3] ** 2) + turn**2) / 6
        variances, before = (1 / np.diag(one.sqrt_info)[:6] ** 2 for one in (factor, other))
        np.testing.assert_allclose(variances, before + added, rtol=1e-3)
        assert factor.sqrt_info[6, 6] == other.sqrt_info[6, 6]
        np.testing.assert_array_equal(factor.Z_a_b, other.Z_a_b)


def test_a_difference_from_the_prior_counts_in_the_unit_of_the_inference(graph):
    """Points that look twice as far in an inference whose unit is half as long: all lengths are twice as long."""
    frame = replace(look(ring(), 30), points=np.full((4, 4, 3), 5.0), mask=np.ones((4, 4), bool), depth_noise=0.002)
    factor = sequential_factor(frame, list(ring()[:31]), [0.0] * 31, anywhere, graph.noise)
    T, predicted = (np.linalg.inv(poses[30]) @ poses[29] for poses in (ring(), ring(2.05 * np.pi)))
    in_metres, in_halves = (with_disagreement(factor, T, predicted, (depth, 5.0)) for depth in (5.0, 10.0))
    as_long = 1 / np.diag(factor.sqrt_info)[:3] ** 2
    longer, doubled = (1 / np.diag(one.sqrt_info)[:3] ** 2 - as_long for one in (in_metres, in_halves))
    np.testing.assert_allclose(doubled, 4 * longer)
    np.testing.assert_allclose(np.diag(in_halves.sqrt_info)[3:], np.diag(in_metres.sqrt_info)[3:])
    unknown = with_disagreement(factor, T, np.full((4, 4), np.nan), (5.0, 5.0))
    np.testing.assert_array_equal(unknown.sqrt_info, factor.sqrt_info)


@pytest.mark.parametrize("kind", ["drawn anew", "in another world", "lost before", "of one inference"])
def test_only_a_repeated_prediction_is_compared_with_the_map(graph, kind):
    """A network that predicts a frame anew shows by that how noisy it is, and `graph.noise` holds for it."""
    placed, odometry = ring(), ring(2.05 * np.pi)
    before = walked_by(graph, placed[:30], odometry)
    frame = replace(look(odometry, 30), depth_noise=0.002)
    compared = add_node(before, frame, placed[30], 1.0, 27).factors[-2]
    if kind == "drawn anew":
        views = {i: pose @ shifted(0.001) for i, pose in frame.T_anchor_views.items()}
        frame = replace(frame, T_anchor_views=views)
    elif kind == "in another world":
        frame = replace(frame, world=1)
    elif kind == "lost before":
        frame.T_anchor_views[29][:] = np.nan
    else:
        frame = replace(frame, depth_noise=None)
    factor = add_node(before, frame, placed[30], 1.0, 27).factors[-2]
    weights = np.diag(sequential_factor(frame, list(placed[:31]), [0.0] * 31, anywhere, graph.noise).sqrt_info)
    np.testing.assert_allclose(np.diag(factor.sqrt_info), weights)
    assert not np.allclose(np.diag(compared.sqrt_info), weights)


def test_a_loop_of_another_place_is_refused_by_the_prior(graph, drifted):
    end = query_prior(drifted, drifted.verified[:1], told_again(ring(), off=6.0)[0])
    assert [known.a for known in end.verified] == [2, 3, 4] and [known.a for known in end.violating] == [1]
    (refusal,) = end.refusals
    assert (refusal.a, refusal.b, refusal.gate) == (
        1,
        58,
        "revisit",
    ) and refusal.measured > graph.prior_query.max_misfit
    assert counts(end)["loops/refused_revisit"] == 1
    (line,) = [one for one in loop_list(end) if one["outcome"] == "refused"]
    assert "the prior, asked for both together, says otherwise" in loop_why(line)


def test_an_answer_without_a_pose_is_none_and_is_counted(drifted):
    loops, (ask, _) = drifted.verified, told_again(ring())
    end = query_prior(drifted, loops[:1], lambda a, b: replace(ask(a, b), T_a_b=np.full((4, 4), np.nan)))
    assert end.verified == loops and counts(end)["loops/unusable_answers"] == 1
    assert counts(end)["loops/measured_again"] == 0 and revisit_note(end) == []


def test_a_loop_for_which_the_prior_has_no_word_and_one_of_another_run_stay(drifted):
    loops = drifted.verified
    end = query_prior(drifted, loops[:2], lambda a, b: None)
    assert counts(end)["loops/measured_again"] == counts(end)["loops/unusable_answers"] == 0
    (note,) = revisit_note(end)
    assert note.startswith("loops: 2 were measured by keypoints alone") and "graph=default" in note
    assert revisit_note(None) == []
    ask, calls = told_again(ring())
    end = replace(end, first_node=10)
    end = query_prior(end, loops[2:], ask)
    assert calls == [] and all(now is before for now, before in zip(end.verified, loops, strict=True))


def test_what_moves_the_poses_was_asked_for_before(graph, monkeypatch):
    """Of four loops that agree the prior refuses one: the others are edges, and as the prior measures them, too."""
    truth, drifted = ring(), ring(1.95 * np.pi)
    loops = [loop(truth, row) for row in range(1, 5)]
    end = replace(with_keyframes(walked(graph, drifted)), verified=loops)
    right, _ = told_again(truth)
    wrong, _ = told_again(truth, off=6.0)
    asked = lambda a, b: wrong(a, b) if a == 2 else right(a, b)  # noqa: E731
    with monkeypatch.context() as patch:
        for module in (back_end.loops, integrate):
            patch.setattr(module, "consistent_loops", lambda end, since=0: list(end.verified))
        end = finish_back_end(atlas_of(end, state_of(drifted)), asked).graph
    assert [one.a for one in end.accepted] == [1, 3, 4] and [refusal.a for refusal in end.refusals] == [2]
    assert end.accepted[0].sqrt_info[0, 0] > loops[0].sqrt_info[0, 0]
    assert error(end.poses, truth) < 0.5 * error(drifted, truth)
    # Two of them against it, and all that imply the same correction fall.
    end = with_keyframes(walked(graph, drifted))
    end = replace(end, verified=[loop(truth, row) for row in range(1, 9)])
    assert len(consistent_loops(end)) == 8
    end = finish_back_end(atlas_of(end, state_of(drifted)), wrong).graph
    assert end.accepted == [] and len(end.refusals) == 3 and consistent_loops(end) == []
    assert error(end.poses, drifted) == 0


@pytest.mark.parametrize("has_loop", [True, False])
def test_a_map_whose_visits_were_joined_is_settled_at_the_end_with_the_noise_of_its_frames(
    graph, monkeypatch, has_loop
):
    truth, drifted = ring(), ring(1.95 * np.pi)
    end = walked(graph, drifted)
    end = replace(end, verified=[loop(truth, row) for row in range(1, 9)] if has_loop else [])
    noise = [0.01 * (row % 3) if row < COUNT // 3 else 9.0 for row in range(COUNT)]
    end = changed(end, depth_noise=noise, is_placed=[one < 9.0 for one in noise])  # the others fit nothing
    asked, config = [], SimpleNamespace(existence="gates", submap=SimpleNamespace(map_capacity=COUNT))

    def settled(state, end, gates):
        asked.append((float(depth_noise_of(end)), gates, end.poses))
        return replace(state, time=jnp.asarray(-1))

    monkeypatch.setattr(integrate, "merge_duplicates_of_state", settled)
    atlas = finish_back_end(replace(atlas_of(end, state_of(drifted)), config=config))
    assert [one[:2] for one in asked] == ([(np.float32(0.01), "gates")] if has_loop else [])
    assert (atlas.state.time == -1) == has_loop
    for *_, poses in asked:
        np.testing.assert_allclose(poses, atlas.graph.poses, atol=1e-5)


def sheets(graph, births, second=(0.0, 0.0, 0.0)) -> tuple[BackEnd, SlamState]:
    """Two pairs of Gaussians 4 cm behind each other, 5 m apart, and two nodes, the second at a place given."""
    apart = [[0.0, 0, 3.0], [0, 0, 3.04], [5, 0, 3.0], [5, 0, 3.04]]
    cov, normal = jnp.diag(jnp.array([0.05, 0.05, 0.003])) ** 2, jnp.array([0.0, 0, -1])
    gaussians = random_gaussians(4)
    rows = jnp.asarray(apart, jnp.float32), jnp.tile(cov, (4, 1, 1)), jnp.tile(normal, (4, 1))
    gaussians = eqx.tree_at(lambda g: (g.means, g.covs, g.normals), gaussians, rows)
    gaussians = eqx.tree_at(lambda g: g.features, gaussians, jnp.zeros((4, 0)))
    map = new_map(gaussians, jnp.ones(4), jnp.ones(()), jnp.asarray(0))
    map = eqx.tree_at(lambda m: m.birth, map, jnp.asarray(births, jnp.int32))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = second
    nodes = tuple(Node(pose, pose, 0.0, row, depth_noise=0.02) for row, pose in enumerate(poses))
    return BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01, nodes), replace(state_of(ring()), map=map)


def test_a_gaussian_is_seen_from_the_node_of_its_birth(graph):
    """Two sheets of a wall before the first node, and two that the second one sees from beside."""
    end, state = sheets(graph, [0, 0, 1, 1], (8.0, 0.0, 3.0))
    after = merge_duplicates_of_state(state, end, load_config().slam.existence)
    np.testing.assert_array_equal(after.map.gaussians.valid, [True, False, True, True])


@pytest.mark.slow
def test_one_layer_has_the_rows_of_what_the_first_nodes_have_made(graph):
    """Whichever of the two is nearer to the camera."""
    end, state = sheets(graph, [0, 1, 1, 0])
    after = one_layer_of_state(state, end, [False, True], load_config().slam.existence)
    np.testing.assert_array_equal(after.map.gaussians.valid, [True, False, False, True])
    np.testing.assert_allclose(np.asarray(after.map.gaussians.means)[[0, 3], 2], 3.02, atol=1e-5)


def test_the_map_follows_poses_that_the_prior_changes_and_loops_of_the_graph_give_way(graph):
    """The second node moves by 30 cm; what registration had added to its prediction stays, what a loop had, goes."""
    graph = replace(graph, deform=replace(graph.deform, num_neighbours=1))  # each Gaussian with its own node
    end, state = sheets(graph, [0, 0, 1, 1], (8.0, 0.0, 3.0))
    state = replace(state, time=jnp.asarray(2, jnp.int32))
    anchor = shifted(1.0, 0.0, 0.0)  # of the first frame in the world
    predicted = [np.eye(4), np.linalg.inv(anchor) @ shifted(7.9, 0.0, 3.0)]  # 10 cm beside the estimate
    online = [np.eye(4), shifted(8.0, 0.0, 3.0)]
    nodes = [
        replace(node, online=pose, predicted=one) for node, pose, one in zip(end.nodes, online, predicted, strict=True)
    ]
    nodes[1] = replace(nodes[1], pose=shifted(8.0, 0.5, 3.0))  # by a loop
    factor = Factor(1, 0, np.linalg.inv(nodes[1].pose), 0.0, np.eye(7), is_loop=False)
    end = replace(end, nodes=tuple(nodes), factors=[factor, factor._replace(is_loop=True)])
    adjusted = {1: predicted[1] @ shifted(0.0, 0.0, 0.3), 7: np.eye(4)}
    after, moved = follow_prior(end, state, adjusted, anchor)
    np.testing.assert_allclose(after.nodes[0].pose, end.nodes[0].pose)
    np.testing.assert_allclose(after.nodes[1].pose[:3, 3], [8.0, 0.0, 3.3], atol=1e-9)
    np.testing.assert_allclose(after.factors[0].Z_a_b, np.linalg.inv(after.nodes[1].pose), atol=1e-9)
    np.testing.assert_array_equal(after.factors[1].Z_a_b, factor.Z_a_b)  # a loop is measured
    means, before = (np.asarray(one.map.gaussians.means) for one in (moved, state))
    np.testing.assert_array_equal(means[:2], before[:2])
    np.testing.assert_allclose(means[2:] - before[2:], [[0, -0.5, 0.3]] * 2, atol=1e-5)
    same, untouched = follow_prior(end, state, {}, anchor)
    assert_same(untouched.map, state.map)
    assert [node.pose is other.pose for node, other in zip(same.nodes, end.nodes, strict=True)] == [True, True]


@pytest.mark.parametrize("motion", [None, np.eye(4), on_ring([0.3])[0]])
def test_the_map_follows_also_after_relocalization_has_moved_the_world_of_the_prior(graph, monkeypatch, motion):
    """Symptom: after one relocalization no adjusted pose was followed for the rest of a run."""
    M = np.eye(4) if motion is None else motion
    anchor, old, new = shifted(1.0), shifted(0.0, 0.0, 0.2), shifted(0.0, 0.0, 0.5)
    poses = [M @ anchor, M @ anchor @ old]
    nodes = tuple(
        Node(T, T, 0.0, row, predicted=one) for row, (T, one) in enumerate(zip(poses, (np.eye(4), old), strict=True))
    )
    end = BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01, nodes)
    state = replace(state_of(ring()), time=jnp.asarray(2, jnp.int32))
    world = World(motion=None if motion is None else to_se3(motion))
    monkeypatch.setattr(integrate, "place", lambda atlas, window: (atlas, Event(poses[1][None]), None))
    monkeypatch.setattr(integrate, "update_graph", lambda atlas, *_: atlas)
    window = SimpleNamespace(seconds={}, adjusted={1: new}, T_world_anchor=anchor)
    after, _ = integrate.integrate(replace(atlas_of(end, state), world=world), window)
    np.testing.assert_allclose(after.graph.nodes[1].pose, M @ anchor @ new, atol=1e-6)


def test_a_window_factor_follows_what_the_prior_predicts_and_no_estimate(graph):
    """Symptom: after an adjustment it had the difference of the estimates, which says nothing new of the path."""
    state, poses = replace(state_of(ring()), time=jnp.asarray(3, jnp.int32)), [shifted(one) for one in (0.0, 1.0, 2.0)]
    predicted = [shifted(0.0), shifted(1.1), shifted(2.2)]
    rows = enumerate(zip(poses, predicted, strict=True))
    nodes = tuple(Node(pose, pose, 0.0, row, predicted=one) for row, (pose, one) in rows)
    window = Factor(2, 0, shifted(-2.2), 0.0, np.eye(7), is_loop=False, is_predicted=True)
    chain = Factor(1, 0, shifted(-1.0), 0.0, np.eye(7), is_loop=False)
    end = replace(BackEnd(graph, (300.0, 300.0, 160.0, 120.0), 0.01, nodes), factors=[window, chain])
    after, _ = follow_prior(end, state, {2: shifted(2.6)}, np.eye(4))
    np.testing.assert_allclose(after.factors[0].Z_a_b, shifted(-2.6))
    assert after.factors[1] is chain, "of nodes that stay"
    after, _ = follow_prior(end, state, {1: shifted(1.5)}, np.eye(4))
    assert after.factors[0] is window, "the prior says of its two frames what it said"
    np.testing.assert_allclose(after.factors[1].Z_a_b, shifted(-1.4))
    unknown = replace(end, nodes=(replace(nodes[0], predicted=None), *nodes[1:]))
    after, _ = follow_prior(unknown, state, {2: shifted(2.6)}, np.eye(4))
    np.testing.assert_array_equal(after.factors[0].Z_a_b, window.Z_a_b)


def shifted(*translation: float) -> np.ndarray:
    """A pose (4, 4) without rotation."""
    T = np.eye(4)
    T[: len(translation), 3] = translation
    return T
