"""A camera that is carried off, and one that comes into a saved map; the true poses are the oracle."""

import itertools
from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from loop_scene import matrix
from omegaconf import OmegaConf
from scene import assert_same

from emgs_jax import load_config, load_map
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.localization import LEAST_NOISE
from emgs_jax.loops.two_views import gap_between
from emgs_jax.prior.base import Prior, PriorPrediction
from emgs_jax.report.metrics import score_back_end
from emgs_jax.report.run_files import save_progress
from emgs_jax.running.checkpoint import CheckpointConfig, Keeper
from emgs_jax.running.configure import build_dataset, build_prior
from emgs_jax.running.drive import map_frames
from emgs_jax.running.places import load_saved
from emgs_jax.running.record import MappingRun, new_run

WORDS = ("experiment=smoke", "dataset.num_frames=80", "dataset.stop=80", "prior.level=0", "graph=default")
THERE, BACK = range(0, 24, 2), (7, 9, 11, 13, 15)  # frames of the path: what is mapped, and views between these
MAX_DISTANCE, MAX_TURN = 0.05, 2.0  # the bar, where the prior errs; here it is exact


@cache
def config(*words: str):
    return load_config(*WORDS, *words)


@cache
def settings(*words: str):
    return OmegaConf.create(config(*words).settings)


def walk(numbers) -> ReadableFrames:
    """Frames of the path in any order."""
    frames = ReadableFrames(build_dataset(settings())._dataset)
    frames.kept = tuple(numbers)
    return frames


class Blinded(Prior):
    """A prior that is in another world from one frame on, and knows there of the frames before where the first is."""

    def __init__(self, prior: Prior, cut: int) -> None:
        self._prior, self._cut, self.provenance = prior, cut, prior.provenance
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def predict(self, window, frames, intrinsics) -> PriorPrediction:
        found = self._prior.predict(window, frames, intrinsics)
        if window.current < self._cut:
            return found
        poses, mask = matrix((20, 60, 10), (4.0, 1.0, -3.0)) @ found.T_anchor_view, found.mask.copy()
        poses[[0 < view < self._cut for view in window.views]] = np.nan
        poses[0] = np.eye(4)
        mask[[view < self._cut for view in window.dense]] = False
        return replace(found, T_anchor_view=poses, mask=mask)


class Misled(Prior):
    """A prior that errs by one motion, always the same, between all frames before a cut and all from it on."""

    motion = matrix((0, 40, 0), (0.0, 0.0, 1.5))

    def __init__(self, prior: Prior, cut: int) -> None:
        self._prior, self._cut, self.provenance = prior, cut, prior.provenance
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def predict(self, window, frames, intrinsics) -> PriorPrediction:
        found = self._prior.predict(window, frames, intrinsics)
        poses = found.T_anchor_view.copy()
        later = [view >= self._cut for view in window.views]
        poses[later] = self.motion @ poses[later]
        return replace(found, T_anchor_view=poses)


def mapped(
    frames: ReadableFrames, prior: Prior, saved=None, keeper=None, stop: int | None = None, words=()
) -> MappingRun:
    """A run; one that is stopped after so many frames leaves its checkpoint."""
    run = new_run(frames, config(*words).slam, graph=config(*words).graph, saved=saved)
    views = map_frames(run, frames, prior, keeper)
    for _ in itertools.islice(views, stop):
        pass
    if stop is not None:
        keeper.save()
    return run


def off(run: MappingRun, row: int) -> tuple[float, float]:
    """Distance and degrees from the truth."""
    record = run.records[row]
    return gap_between(record.pose, record.true_pose)


@cache
def kidnapped() -> MappingRun:
    frames = walk((*THERE, *BACK))
    return mapped(frames, Blinded(build_prior(settings(), frames), len(THERE)))


@pytest.mark.slow
def test_a_camera_that_was_carried_off_comes_back():
    run, patience = kidnapped(), config().graph.location.patience
    first = len(THERE)
    assert all(record.location is None for record in run.records[: first + patience - 1])
    lost = [record.status for record in run.records[first : first + patience - 1]]
    assert set(lost) <= {"degraded", "lost"}, "nothing leads from the frames before to these"
    found = run.records[first + patience - 1 :]
    assert [record.location for record in found] == ["found", None, None]
    assert [record.status for record in found] == ["tracked"] * 3
    for row in range(first + patience - 1, len(run.records)):
        distance, turn = off(run, row)
        assert distance <= MAX_DISTANCE and turn <= MAX_TURN, row
    assert score_back_end(run)["location/found"] == 1
    end = run.back_end
    assert end.since == first + patience - 1 and not end.is_placed[first]
    assert not any(edge.a >= end.since > edge.b and edge.b >= first for edge in end.edges), "lost frames hold nothing"
    unplaced = [edge for edge in end.edges if not end.is_placed[edge.a] and edge.a == edge.b + 1]
    unsure = 1 / (config().graph.noise.depth * config().graph.noise.pair)
    assert unplaced and all(edge.sqrt_info[5, 5] == pytest.approx(unsure) for edge in unplaced), (
        "few points fit exactly"
    )


NOWHERE = ("graph.location.min_inliers=100000", "graph.max_known=1e9", "graph.location.max_patience=4")


@pytest.mark.slow
def test_the_map_goes_on_where_the_prior_leads_when_the_camera_is_found_nowhere():
    """And it is right relative to the frame where it began anew, as the prior is; the frames before stay."""
    frames, cut = walk((*THERE[:5], *range(1, 17, 2))), 5
    run = mapped(frames, Misled(build_prior(settings(), frames), cut), words=NOWHERE)
    anew = cut + 3
    assert [record.status for record in run.records[cut:anew]] == ["degraded"] * 3
    assert [record.location for record in run.records[anew:]] == ["anew"] + [None] * 4
    first = run.records[anew]
    assert first.status == "initialization" and first.new > 0 and first.reason is not None
    assert [record.status for record in run.records[anew + 1 :]] == ["tracked"] * 4
    for row, record in enumerate(run.records):
        start = run.records[0]
        path = np.linalg.inv(start.true_pose) @ record.true_pose
        assert max(gap_between(record.pose, start.pose @ (path if row < cut else Misled.motion @ path))) < 0.02, row
    births = np.asarray(run.map.birth)[np.asarray(run.map.gaussians.valid)]
    assert np.sum(births == anew) > first.new // 2  # some were joined with later ones
    assert not np.any((births >= cut) & (births < anew))
    assert run.back_end.is_placed == [True] * cut + [False] * 3 + [True] * 5


@pytest.mark.slow
def test_nothing_begins_anew_where_nothing_leads():
    """The prior knows nothing of the frames before: where these are relative to the map is not known."""
    frames = walk((*THERE[:5], *range(1, 17, 2)))
    run = mapped(frames, Blinded(build_prior(settings(), frames), 5), words=NOWHERE)
    assert {record.status for record in run.records[5:]} <= {"degraded", "lost"}
    assert "anew" not in {record.location for record in run.records}


def same_run(one: MappingRun, other: MappingRun) -> None:
    """Map, poses and what the back end knows, to the bit."""
    assert_same(jax.device_get(one.state), jax.device_get(other.state))
    np.testing.assert_array_equal(one.poses, other.poses)
    np.testing.assert_array_equal(one.back_end.poses, other.back_end.poses)
    assert [record.location for record in one.records] == [record.location for record in other.records]


@pytest.mark.slow
def test_a_run_that_is_stopped_after_it_came_back_has_the_same_bits(tmp_path):
    frames, patience = walk((*THERE, *BACK)), config().graph.location.patience
    keep = lambda: Keeper(tmp_path / "checkpoint.npz", CheckpointConfig(every=1000), {})  # noqa: E731
    prior = Blinded(build_prior(settings(), frames), len(THERE))
    stopped = mapped(frames, prior, keeper=keep(), stop=len(THERE) + patience + 1)
    assert len(stopped.records) < len(frames) and "found" in [record.location for record in stopped.records]
    keeper = keep()
    assert keeper.found is not None
    same_run(mapped(frames, prior, keeper=keeper), kidnapped())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, frames = tmp_path_factory.mktemp("saved"), walk(THERE)
    save_progress(folder, mapped(frames, build_prior(settings(), frames)))
    (folder / "metrics.json").write_text("{}")  # a finished run's
    return folder


def visit(folder, mode: str, numbers=BACK) -> MappingRun:
    frames, words = walk(numbers), ("prior.seed=7",)
    saved = load_saved(str(folder), mode, config().graph, frames.intrinsics, 0.01)
    return mapped(frames, build_prior(settings(*words), frames), saved)


@pytest.mark.slow
def test_frames_are_located_in_a_saved_map_and_it_stays_as_it_is(folder):
    run = visit(folder, "locate")
    assert run.records[0].location == "found" and {record.status for record in run.records} == {"tracked"}
    for row in range(len(run.records)):
        distance, turn = off(run, row)
        assert distance <= MAX_DISTANCE and turn <= MAX_TURN, row
    assert_same(jax.device_get(run.map), jax.device_get(load_map(folder / "map.npz")))
    assert len(run.back_end.poses) == len(THERE) and {record.new for record in run.records} == {0}


@pytest.mark.slow
def test_a_run_goes_on_in_a_saved_map_and_can_be_saved_itself(folder, tmp_path):
    run = visit(folder, "extend")
    end = run.back_end
    assert run.records[0].location == "found" and len(end.poses) == len(THERE) + len(BACK) and end.first == len(THERE)
    assert int(run.map.birth.max()) >= len(THERE) and int(run.state.time) == len(end.poses)
    new = [edge for edge in end.edges if edge.a >= end.first]
    assert any(edge.b < end.first for edge in new), "the new frames hang on those that the map was made from"
    assert all(edge.sqrt_info[6, 6] == 0 for edge in new if edge.b < end.first), "by the map: no window has both"
    noise = config().graph.noise
    for edge in new:
        told = max(run.records[edge.a - end.first].depth_noise, LEAST_NOISE)
        angle = noise.pair if edge.sqrt_info[6, 6] else noise.map
        assert edge.sqrt_info[5, 5] == pytest.approx(1 / (told * angle)), "as sure as its frame's depths"
    save_progress(tmp_path, run)
    (tmp_path / "metrics.json").write_text("{}")
    again = load_saved(str(tmp_path), "extend", config().graph, end.intrinsics, 0.01)
    assert again.back_end.first == len(THERE) + len(BACK)
    assert_same(jax.device_get(again.map), jax.device_get(run.map))


@pytest.mark.slow
def test_a_run_in_a_saved_map_that_is_stopped_has_the_same_bits(folder, tmp_path):
    frames = walk(BACK)
    prior = build_prior(settings(), frames)
    begin = lambda: load_saved(str(folder), "extend", config().graph, frames.intrinsics, 0.01)  # noqa: E731
    keep = lambda: Keeper(tmp_path / "checkpoint.npz", CheckpointConfig(every=1000), {})  # noqa: E731
    mapped(frames, prior, begin(), keep(), stop=3)
    same_run(mapped(frames, prior, begin(), keep()), mapped(frames, prior, begin()))


@pytest.mark.slow
def test_images_of_another_place_are_not_found_and_the_run_says_so(folder):
    other = ReadableFrames(build_dataset(settings("dataset.seed=5"))._dataset)
    other.kept = tuple(BACK)
    saved = load_saved(str(folder), "locate", config().graph, other.intrinsics, 0.01)
    with pytest.raises(ValueError, match=r"none of the 5 frames is found in the saved map \(.*matches"):
        mapped(other, build_prior(settings(), other), saved)
