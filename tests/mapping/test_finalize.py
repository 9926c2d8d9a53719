"""The covariances of a run that ends have the first frame's own error in them, as it is seen from each frame."""

import json
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hand_run import run_of
from scene import flat_gaussians, fresh_map, pose, random_gaussians, random_observation, slam_config

from emgs_jax.gaussian_map import new_map
from emgs_jax.io.run_lengths import from_run_lengths, to_run_lengths
from emgs_jax.mapping import integrate
from emgs_jax.mapping.atlas import Submap
from emgs_jax.mapping.event import Event
from emgs_jax.mapping.finalize import own_covariance, with_first_frame
from emgs_jax.mapping.pipeline import finish_run, with_atlas, with_looks_ended, with_outcome
from emgs_jax.mapping.records import FrameRecord, to_line
from emgs_jax.mapping.run import MappingRun
from emgs_jax.motion import no_looks
from emgs_jax.observation import transform
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.runs.files import save_progress
from emgs_jax.slam import SlamState, as_seen
from tools.nees import pose_errors

COUNT = 1e6  # repeats beside which the guess does not count
DIFFERENCE = np.array([0.01, 0.004])  # between two answers about a motion: mean depths and rad, per axis


def a_run(count: float = COUNT, shared: float = 0.75) -> MappingRun:
    poses = [np.asarray(pose((0.3 * i, 0.2, -0.4 * i), (1.0 + i, -2.0, 0.5)).as_matrix(), float) for i in range(3)]
    records = [FrameRecord(0, None, None, "initialization", pose=poses[0])]
    records += [FrameRecord(i, None, None, "tracked", pose=poses[i], covariance=1e-4 * np.eye(6)) for i in (1, 2)]
    logs = jnp.asarray(np.stack([np.log(DIFFERENCE**2)] * 2) - 0.36898, jnp.float32)  # of χ² with three degrees
    known = logs, jnp.asarray([count, 0.0]), jnp.asarray(0.02)
    estimate = eqx.tree_at(lambda b: (b.repeats.log_squares, b.repeats.counts, b.depth_noise), exact_estimate(), known)
    last = jaxlie.SE3.from_matrix(jnp.asarray(poses[-1], jnp.float32))
    map = new_map(random_gaussians(9), jnp.ones(9), jnp.ones(()), jnp.asarray(0))
    seen = transform(last, random_observation(20), jnp.ones(()))
    state = SlamState(map, seen, last, estimate, jnp.asarray(3))
    return run_of(records, state, slam_config(f"slam.localization.pose_shared={shared}"))


def ended(run: MappingRun) -> MappingRun:
    atlas, own = with_first_frame(run.atlas, run.records[0].pose)
    return replace(with_atlas(run, atlas), first_covariance=own)


def test_the_first_frame_is_as_uncertain_as_half_a_window_of_motions_turned_out_to_be():
    run = a_run()
    of_motion = DIFFERENCE / np.sqrt(2 * 0.25)  # two answers differ by the variance 2 (1 - c) v
    depth = np.mean(np.asarray(random_observation(20).points)[:, 2])
    own = own_covariance(run.state, run.config.localization)
    std = np.sqrt(run.config.window_size / 2) * np.repeat(of_motion * [depth, 1.0], 3)
    np.testing.assert_allclose(own, np.diag(std**2), rtol=1e-3)


@pytest.mark.parametrize("settings", [{"count": 0.0}, {"shared": 1.0}])
def test_where_answers_say_nothing_of_each_other_nothing_is_added(settings):
    run = a_run(**settings)
    assert with_first_frame(run.atlas, np.eye(4)) == (run.atlas, None)


def test_what_is_added_is_the_scatter_of_the_poses_relative_to_a_first_frame_that_is_off():
    run, rng = a_run(), np.random.default_rng(0)
    own, first = own_covariance(run.state, run.config.localization), run.records[0].pose
    before = [record.covariance for record in run.records]
    run = ended(run)
    assert run.records[0].covariance is None, "the first frame itself has none"
    draws = jaxlie.SE3.exp(jnp.asarray(rng.multivariate_normal(np.zeros(6), own, 4000), jnp.float32)).as_matrix()
    for row in (1, 2):
        ours = np.linalg.inv(first) @ run.records[row].pose
        errors = pose_errors(ours[None], np.linalg.inv(first @ np.asarray(draws, float)) @ run.records[row].pose)
        added = run.records[row].covariance - before[row]
        std = np.sqrt(np.diag(added))
        np.testing.assert_allclose(np.cov(errors.T) / std / std[:, None], added / std / std[:, None], atol=0.07)


def test_the_file_of_the_frames_says_it_too(tmp_path):
    run = a_run()
    records = [replace(record, timestamp=0.1 * record.index) for record in run.records]
    lost = FrameRecord(3, None, 0.3, "lost", pose=records[-1].pose)
    run = run_of((*records, lost), run.state, run.config)
    lines = [json.dumps(to_line(record), default=np.ndarray.tolist) for record in run.records]
    skipped = json.dumps(to_line(FrameRecord(9, None, None, "skipped")))
    (tmp_path / "frames.jsonl").write_text("\n".join([skipped, *lines]) + "\n")
    run = ended(run)
    save_progress(tmp_path, run)
    found = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert found[0]["status"] == "skipped" and found[-1]["covariance"] is None
    for line, record in zip(found[2:4], run.records[1:3], strict=True):
        np.testing.assert_allclose(line["covariance"], record.covariance, rtol=1e-4, atol=1e-10)
        assert np.max(line["covariance"]) > 2e-4


def test_frames_of_a_submap_that_was_never_joined_are_not_relative_to_the_first_frame():
    atlas = a_run().atlas
    nodes = [*atlas.graph.nodes[:2], *(replace(node, submap=1) for node in atlas.graph.nodes[2:])]
    found, own = with_first_frame(replace(atlas, graph=replace(atlas.graph, nodes=tuple(nodes))), np.eye(4))
    assert own.any() and found.graph.nodes[1] is not nodes[1] and found.graph.nodes[2] is nodes[2]


def test_of_parts_that_never_met_the_first_frame_of_the_map_is_that_of_the_part_that_is_kept():
    """It was that of the other part, from whose world no distance leads to the poses of the map."""
    run = a_run()
    nodes = [replace(node, submap=min(row, 1)) for row, node in enumerate(run.atlas.graph.nodes)]
    graph, submaps = replace(run.atlas.graph, nodes=tuple(nodes), active=1), {k: Submap(run.state) for k in (0, 1)}
    run = finish_run(replace(run, atlas=replace(run.atlas, graph=graph, submaps=submaps)))
    assert run.records[0].submap == 0 and run.records[1].submap is None
    np.testing.assert_allclose(run.records[1].covariance, 1e-4 * np.eye(6) + run.first_covariance, atol=1e-12)


def test_poses_in_a_saved_map_are_not_relative_to_a_first_frame():
    atlas = a_run().atlas
    atlas = replace(atlas, graph=replace(atlas.graph, first_node=1))
    assert with_first_frame(atlas, np.eye(4)) == (atlas, None)


def test_what_the_last_frames_saw_move_is_taken_out_of_the_map_and_written_into_their_records(monkeypatch):
    """The second frame of four has seen something move in a quarter of its pixels, as later ones have shown."""
    config = slam_config("slam.observation.thin=1", "slam.motion.num_looks=3", "slam/existence=default")
    camera, depth = Camera([20.0, 20.0], [7.5, 5.5], 16, 12), 2.0
    columns = np.indices((12, 16))[1].reshape(-1)
    there = (np.indices((12, 16)).reshape(2, -1).T[:, ::-1] - [7.5, 5.5]) / 20.0 * depth
    means = np.concatenate([there, np.full((192, 1), depth)], axis=1)
    gaussians = flat_gaussians(means, 0.02, (0.0, 0.0, -1.0), 0.003)
    map = new_map(gaussians, jnp.ones(192), jnp.ones(()) * 0.5, jnp.asarray(0))
    poses = [np.eye(4)] * 4
    records = [FrameRecord(i, None, None, "tracked", pose=pose, moving=0.0) for i, pose in enumerate(poses)]
    records[1] = replace(records[1], moving=0.25, moving_pixels=to_run_lengths((columns >= 12).reshape(12, 16)))
    view = random_observation(192)
    looks = no_looks(view, config.motion)
    moves = jnp.asarray(columns < 4)
    looks = replace(
        looks,
        depth=jnp.full((3, 2, 192), depth).at[0].set(0.0),
        moving=looks.moving.at[2].set(moves),
        time=jnp.asarray([-1, 5, 4], jnp.int32),
    )
    estimate = eqx.tree_at(lambda b: b.depth_noise, exact_estimate(), jnp.asarray(0.01))
    state = SlamState(map, view, jaxlie.SE3.identity(), estimate, jnp.asarray(7), looks)
    run = run_of(records, state, config)
    run = replace(run, atlas=replace(run.atlas, camera=camera))
    oldest = as_seen(jax.tree.map(lambda leaf: leaf[2], looks), state.T_world_previous, jnp.asarray(0.01))
    info = SimpleNamespace(seen=jax.device_get(oldest), moving=np.zeros((12, 16), bool))
    outcome = with_outcome(run, run.atlas, SimpleNamespace(info=info, seen=[]))
    assert [record.moving for record in outcome.records] == [0.0, 0.5, 0.0, 0.0], "as a step says it that ends this"
    after = with_looks_ended(run, 6)  # of the record of the last frame
    settings = config.existence
    is_back = columns < 4
    expected = 0.5 - np.where(is_back, settings.hit + settings.miss, 0.0)
    np.testing.assert_allclose(after.map.existence, expected, rtol=1e-6)
    assert [record.moving for record in after.records] == [0.0, 0.5, 0.0, 0.0]
    mask = from_run_lengths(after.records[1].moving_pixels)
    np.testing.assert_array_equal(mask, ((columns < 4) | (columns >= 12)).reshape(12, 16))
    assert after.state.looks is None
    assert with_looks_ended(after, 6).records == after.records
    apart = replace(run.atlas, submaps={**run.atlas.submaps, 1: Submap(replace(state, looks=None))})
    apart = replace(run, atlas=replace(apart, graph=replace(apart.graph, active=1)))
    left = with_looks_ended(apart, 6)  # a submap that the run has left counts, too
    np.testing.assert_allclose(left.atlas.submaps[0].state.map.existence, expected, rtol=1e-6)
    assert left.records == after.records and left.atlas.submaps[0].state.looks is None
    frozen = replace(run.atlas, submaps={0: replace(run.atlas.submaps[0], is_frozen=True)})
    still = with_looks_ended(replace(run, atlas=frozen), 6)
    np.testing.assert_array_equal(still.map.existence, map.existence)
    joined = with_outcome(run, run.atlas, SimpleNamespace(info=None, seen=[jax.device_get(oldest)]))
    assert joined.records == outcome.records
    found = SimpleNamespace(submap=0)
    monkeypatch.setattr(integrate, "place", lambda atlas, window: (atlas, Event(np.eye(4)[None]), found))
    monkeypatch.setattr(integrate, "update_graph", lambda atlas, *_: atlas)
    window = SimpleNamespace(seconds={}, adjusted={})  # a frame of 1 is found in 0
    atlas, event = integrate.integrate(apart.atlas, window)
    np.testing.assert_allclose(atlas.submaps[0].state.map.existence, expected, rtol=1e-6)
    assert sorted(int(seen.time) for seen in event.seen) == [4, 5] and atlas.submaps[0].state.looks is None


@pytest.mark.parametrize("stays", [None, "frozen", "interrupted", "paper", "no noise"])
def test_two_sheets_of_a_wall_are_one_when_a_run_ends(stays):
    """The first frame's wall is 4 cm behind the second's, which more frames have seen."""
    grid = np.stack(np.meshgrid(np.arange(-1, 1.01, 0.1), np.arange(-1, 1.01, 0.1)), axis=-1).reshape(-1, 2)
    walls = [np.column_stack([grid, np.full(len(grid), z)]) for z in (3.04, 3.0)]
    gaussians = flat_gaussians(np.concatenate(walls), 0.05, (0.0, 0.0, -1.0), 0.003)
    is_second = np.repeat([False, True], len(grid))
    map = fresh_map(gaussians, np.where(is_second, 9.0, 1.0), 1.0, is_second)
    config = slam_config(f"slam/existence={'paper' if stays == 'paper' else 'default'}")
    records = [FrameRecord(i, None, None, "tracked", pose=np.eye(4)) for i in range(2)]
    view = random_observation(20)
    run = run_of(records, SlamState(map, view, jaxlie.SE3.identity(), exact_estimate(), jnp.asarray(2)), config)
    noise = None if stays == "no noise" else 0.02
    nodes = tuple(replace(node, depth_noise=noise) for node in run.atlas.graph.nodes)
    submaps = {0: replace(run.atlas.submaps[0], is_frozen=stays == "frozen")}
    run = replace(run, atlas=replace(run.atlas, graph=replace(run.atlas.graph, nodes=nodes), submaps=submaps))
    ended = finish_run(run, is_interrupted=stays == "interrupted")
    np.testing.assert_array_equal(ended.map.gaussians.valid, is_second | (stays is not None))


def test_how_far_the_last_frame_sees_is_said_by_its_valid_points_alone():
    """The variance of a translation grows with the square of their mean depth, that of a rotation with none."""
    run = a_run()
    depths = np.asarray(random_observation(20).points)[:, 2]
    is_near = depths < np.median(depths)
    state = eqx.tree_at(lambda s: s.previous.valid, run.state, jnp.asarray(is_near))
    own, of_all = (own_covariance(s, run.config.localization) for s in (state, run.state))
    nearer = depths[is_near].mean() / depths.mean()
    assert nearer < 0.9
    np.testing.assert_allclose(np.diag(own) / np.diag(of_all), np.repeat([nearer**2, 1.0], 3), rtol=1e-4)
