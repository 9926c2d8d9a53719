"""Parts of a run without a relation; oracles: true poses and surfaces, similarities by hand, bits of other runs."""

import sys
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hand_run import random_poses, random_similarity
from loop_scene import matrix
from scene import assert_same, random_gaussians, random_observation
from scipy.spatial import cKDTree
from test_coming_back import config, mapped, same_run, settings, walk

from emgs_jax.data.base import Frame
from emgs_jax.gaussian_map import new_map
from emgs_jax.loops.location import Location
from emgs_jax.loops.two_views import gap_between
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import Prior, PriorPrediction
from emgs_jax.registration.belief import certain
from emgs_jax.report.metrics import score_back_end
from emgs_jax.report.run_files import save_progress
from emgs_jax.running import segments
from emgs_jax.running.back_end import BackEnd
from emgs_jax.running.checkpoint import CheckpointConfig, Keeper
from emgs_jax.running.configure import build_prior
from emgs_jax.running.places import load_saved
from emgs_jax.running.record import UNJOINED, FrameRecord, MappingRun
from emgs_jax.running.segments import join, moved_pose, scale_of
from emgs_jax.slam import SlamState

THERE, BACK = tuple(range(0, 20, 2)), tuple(range(26, 12, -2))  # frames of the path; the second part comes to the first
WHOLE = (*THERE, *BACK)
NEVER = "graph.location.min_inliers=100000"
UNIT = 1.25  # of the second part: what the prior gives there as that is a metre


class Apart(Prior):
    """A prior with a frame and a unit of its own from one frame on, that knows nothing there of the frames before."""

    def __init__(self, prior: Prior, cut: int, is_silent: bool = False) -> None:
        self._prior, self._cut, self._is_silent, self.provenance = prior, cut, is_silent, prior.provenance
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def predict(self, window, frames, intrinsics) -> PriorPrediction:
        found = self._prior.predict(window, frames, intrinsics)
        poses, mask = found.T_anchor_view.copy(), found.mask.copy()
        if window.current < self._cut:
            poses[[view >= self._cut for view in window.views]] = (
                np.nan
            )  # the newest is where it does not know any more
            return replace(found, T_anchor_view=poses)
        poses = matrix((20, 60, 10), (4.0, 1.0, -3.0)) @ poses
        poses[:, :3, 3] *= UNIT
        poses[[view < self._cut for view in window.views]] = np.nan
        mask[[view < self._cut for view in window.dense]] = False
        points = np.float32(UNIT) * found.points
        if self._is_silent:
            poses[:], mask[:], points = np.nan, False, 0 * points
        return replace(found, T_anchor_view=poses, mask=mask, points=points)


def ran(numbers, cut: int, *words: str, **more) -> MappingRun:
    frames = walk(numbers)
    return mapped(frames, Apart(build_prior(settings(), frames), cut), words=words, **more)


@cache
def apart(numbers, cut: int, *words: str) -> MappingRun:
    return ran(numbers, cut, *words)


def joined() -> MappingRun:
    return apart(WHOLE, len(THERE))


def first_joined(run: MappingRun) -> int:
    return [record.location for record in run.records].index("joined")


@pytest.mark.slow
def test_a_part_of_another_frame_and_unit_is_joined_where_it_meets_the_map():
    run, cut = joined(), len(THERE)
    said = [record.location for record in run.records]
    assert said[:cut] == [None] * cut and said[cut] == "segment" and said.count("joined") == said.count("segment") == 1
    assert cut < first_joined(run)
    assert [record.status for record in run.records[cut:]] == ["initialization"] + ["tracked"] * (len(BACK) - 1)
    for record in run.records:
        distance, turn = gap_between(record.pose, record.true_pose)
        assert distance < 0.03 and turn < 1.0, record.index
    np.testing.assert_allclose(np.exp(run.back_end.log_scales[cut:]), 1 / UNIT, rtol=0.02)
    np.testing.assert_allclose(scale_of(run.records[first_joined(run)].similarity), 1 / UNIT, rtol=0.02)
    assert not run.aside and set(run.back_end.segments) == {0}
    metrics = score_back_end(run)
    assert metrics["location/segment"] == metrics["location/joined"] == 1


@pytest.mark.slow
def test_what_was_mapped_apart_lies_on_the_true_surfaces_after_it_is_joined():
    run, frames = joined(), walk(WHOLE)
    truth = np.concatenate([surface(frames[row]) for row in range(len(frames))])
    gaussians = run.map.gaussians
    is_apart = np.asarray(gaussians.valid & (run.map.birth >= len(THERE)) & (run.map.birth < first_joined(run)))
    means = np.asarray(gaussians.means)[is_apart]
    distance, _ = cKDTree(truth).query(means)
    assert len(means) > 50 and np.median(distance) < 0.03 and np.quantile(distance, 0.9) < 0.08


def surface(frame: Frame) -> np.ndarray:
    """Points (n, 3) of the true depth, world."""
    fx, fy, cx, cy = walk(THERE).intrinsics
    y, x = np.nonzero(frame.depth > 0)
    z = frame.depth[y, x]
    points = np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], axis=1)
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "num_more"), [((), 1), ((), 5), ((NEVER,), 3)])
def test_a_run_that_is_stopped_in_a_part_or_after_it_was_joined_has_the_same_bits(tmp_path, words, num_more):
    keep = lambda: Keeper(tmp_path / "checkpoint.npz", CheckpointConfig(every=1000), {})  # noqa: E731
    whole = apart(WHOLE, len(THERE), *words)
    stop = len(THERE) + num_more
    ran(WHOLE, len(THERE), *words, keeper=keep(), stop=stop)
    keeper = keep()
    assert keeper.found is not None and len(keeper.found.records) == stop
    was_apart = "joined" not in [record.location for record in keeper.found.records]
    assert bool(keeper.found.aside) == was_apart == (num_more != 5)
    again = ran(WHOLE, len(THERE), *words, keeper=keeper)
    same_run(again, whole)
    assert again.back_end.segments == whole.back_end.segments
    assert [record.status for record in again.records] == [record.status for record in whole.records]


@pytest.mark.slow
@pytest.mark.parametrize("num_before", [len(THERE), 5])
def test_of_parts_that_never_meet_the_one_with_most_placed_frames_is_the_map(tmp_path, num_before):
    numbers = (*THERE[:num_before], *BACK)
    (tmp_path / "frames.jsonl").write_text(
        '{"index": 99, "status": "skipped", "covariance": null}\n'
        + "".join(
            f'{{"index": {row}, "status": "tracked", "reason": null, "pose": [1], "covariance": null}}\n'
            for row in range(len(numbers))
        )
    )
    run = apart(numbers, num_before, NEVER)
    kept = range(num_before) if num_before > 7 else range(num_before, num_before + 7)
    for row, record in enumerate(run.records):
        assert (record.status == "lost" and record.reason == UNJOINED) == (row not in kept), row
    births = np.asarray(run.map.birth)[np.asarray(run.map.gaussians.valid)]
    assert len(births) > 0 and set(births) <= set(kept)
    assert run.back_end.is_placed == [row in kept for row in range(len(numbers))]
    assert {edge.a for edge in run.back_end.edges} <= set(kept)
    assert {one.frame for one in run.back_end.database.keyframes} == set(kept)
    save_progress(tmp_path, run)
    lines = (tmp_path / "frames.jsonl").read_text().splitlines()
    assert "skipped" in lines[0] and [UNJOINED in line for line in lines[1:]] == [
        row not in kept for row in range(len(numbers))
    ]
    (tmp_path / "metrics.json").write_text("{}")
    saved = load_saved(str(tmp_path), "extend", config().graph, run.back_end.intrinsics, 0.01)
    assert_same(jax.device_get(saved.map), jax.device_get(run.map))


@pytest.mark.slow
@pytest.mark.parametrize("cut", [0, 3])
def test_a_prior_that_goes_on_in_a_frame_of_its_own_is_located_in_a_saved_map(tmp_path, monkeypatch, cut):
    """Symptom: every frame of it was refused, because it had no pose in the world from before."""
    monkeypatch.setattr(sys.modules[__name__], "UNIT", 1.05)
    frames = walk(THERE)
    first = mapped(frames, build_prior(settings(), frames))
    save_progress(tmp_path, first)
    (tmp_path / "metrics.json").write_text("{}")
    again = walk(BACK)
    saved = load_saved(str(tmp_path), "locate", config().graph, again.intrinsics, 0.01)
    run = mapped(again, Apart(build_prior(settings("prior.seed=7"), again), cut), saved)
    assert [record.status for record in run.records[cut + 1 :]] == ["tracked"] * (len(BACK) - cut - 1)
    for record in run.records[cut + 1 :]:
        distance, turn = gap_between(record.pose, record.true_pose)
        assert distance < 0.05 and turn < 2.0, record.index


@pytest.mark.slow
def test_without_a_back_end_frames_without_a_relation_are_lost_as_those_of_which_nothing_is_known():
    numbers, cut = (*THERE[:5], *BACK[:3]), 5
    frames = walk(numbers)
    runs = [
        mapped(frames, Apart(build_prior(settings(), frames), cut, is_silent), words=("graph=none",))
        for is_silent in (False, True)
    ]
    assert [record.status for record in runs[0].records[cut:]] == ["lost"] * 3
    assert_same(*(jax.device_get(run.map) for run in runs))
    np.testing.assert_array_equal(*(run.poses for run in runs))


def part(seed: int, births: list[int]) -> SlamState:
    ones = jnp.ones(len(births))
    map = new_map(random_gaussians(len(births), seed=seed), ones, ones[0], jnp.asarray(0))
    map = eqx.tree_at(lambda m: m.birth, map, jnp.asarray(births, jnp.int32))
    last = jaxlie.SE3.identity()
    return SlamState(map, random_observation(20), last, certain(), jnp.asarray(max(births) + 1, jnp.int32))


def two_parts(is_first_aside: bool, similarity: np.ndarray):
    """Nodes 0 to 2 are of segment 0 and 3 to 5 of segment 3; the last node is of the part that is not set aside."""
    rng = np.random.default_rng(3)
    order = [0, 0, 0, 3, 3, 3] if is_first_aside else [3, 3, 3, 0, 0, 0]
    end = BackEnd(config().graph, (300.0, 300.0, 160.0, 120.0), 0.0)
    end.poses, end.log_scales = list(random_poses(rng, 6)), list(rng.normal(size=6))
    end.online = list(random_poses(rng, 6))
    end.frames, end.is_placed, end.segments, end.segment = list(range(6)), [True] * 6, order, order[-1]
    end.locate = lambda look, elsewhere: (Location(np.eye(4), 0.0, 1e-4 * np.eye(7), 1), None)
    states = part(1, [0, 1, 2, 1]), part(2, [3, 4, 5, 5])
    state = eqx.tree_at(lambda s: s.T_world_previous, states[1], segments.to_se3(end.poses[-1]))
    records = [FrameRecord(row, None, None, "tracked", pose=pose, scale=1.5) for row, pose in enumerate(end.poses)]
    records[-1] = replace(records[-1], similarity=similarity)
    slam = config().slam
    slam = replace(slam, submap=replace(slam.submap, map_capacity=4))
    run = MappingRun(
        Camera((5.0, 5.0), (2.0, 1.5), 5, 4),
        slam,
        state=state,
        records=records,
        back_end=end,
        aside={order[0]: states[0]},
    )
    return run, states


@pytest.mark.parametrize("is_first_aside", [True, False])
def test_the_newer_part_moves_as_a_whole_and_the_older_stays(is_first_aside, monkeypatch):
    """Oracle: the similarity applied to every pose, length, mean and covariance."""
    known = random_similarity(np.random.default_rng(5), 1.7)
    similarity = np.eye(4)
    similarity[:3, :3], similarity[:3, 3] = known.scale * known.rotation, known.translation
    run, states = two_parts(is_first_aside, similarity)
    before = [pose.copy() for pose in run.back_end.poses], list(run.back_end.log_scales)
    online = [pose.copy() for pose in run.back_end.online]
    monkeypatch.setattr(segments, "looks_of", lambda given: [None])
    monkeypatch.setattr(segments, "predicted", lambda run, given: None)
    monkeypatch.setattr(segments, "anchored_by", lambda record, prediction: record.scale)
    join(run, None)
    moving = range(3, 6) if is_first_aside else range(3)
    S = similarity if is_first_aside else np.linalg.inv(similarity)
    scale = scale_of(S)
    assert scale == pytest.approx(1.7 if is_first_aside else 1 / 1.7)
    for row in range(6):
        pose, factor = (moved_pose(S, before[0][row]), scale) if row in moving else (before[0][row], 1.0)
        np.testing.assert_allclose(run.back_end.poses[row], pose)
        np.testing.assert_array_equal(run.records[row].pose, run.back_end.poses[row])
        expected = moved_pose(S, online[row]) if row in moving else online[row]
        np.testing.assert_allclose(run.back_end.online[row], expected)
        assert run.back_end.log_scales[row] == pytest.approx(before[1][row] + np.log(factor))
        assert run.records[row].scale == pytest.approx(1.5 * factor)
    assert run.config.submap.map_capacity == 8
    parts = (slice(4, 8), states[0].map), (slice(0, 4), states[1].map)  # what was set aside comes behind
    (newer, was_newer), (older, was_older) = parts[::-1] if is_first_aside else parts
    assert_same(jax.tree.map(lambda leaf: leaf[older], run.state.map), was_older)
    gaussians, were = jax.tree.map(lambda leaf: leaf[newer], run.state.map.gaussians), was_newer.gaussians
    np.testing.assert_allclose(gaussians.means, were.means @ S[:3, :3].T + S[:3, 3], atol=1e-4)
    np.testing.assert_allclose(gaussians.covs, S[:3, :3] @ np.asarray(were.covs) @ S[:3, :3].T, atol=1e-5)
    np.testing.assert_allclose(run.state.T_world_previous.as_matrix(), run.back_end.poses[-1], atol=1e-5)
    assert run.aside == {} and set(run.back_end.segments) == {0} and run.back_end.segment == 0
    assert run.prior_motion == (pytest.approx(1.5 * scale) if is_first_aside else None)
    log_scale = float(run.state.belief.log_scale)
    assert log_scale == pytest.approx(np.log(scale) if is_first_aside else 0.0, abs=1e-6)
    edge = run.back_end.edges[-1]
    measured = np.linalg.inv(run.back_end.poses[1]) @ run.back_end.poses[5]
    np.testing.assert_allclose(edge.Z_a_b[:3, 3] * np.exp(run.back_end.log_scales[1]), measured[:3, 3], atol=1e-9)
    assert (edge.a, edge.b) == (1, 5)
    # The place was found to 1 cm in the map as it was then, whichever of the two has moved since.
    np.testing.assert_allclose(edge.sqrt_info, np.diag([100 * np.exp(before[1][1])] * 3 + [100.0] * 4))
