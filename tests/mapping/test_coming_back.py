"""A camera that is carried off, and one that comes into a saved map; the true poses are the oracle."""

from functools import cache

import jax
import numpy as np
import pytest
from scene import assert_same
from walks import BACK, NEVER_FOUND, THERE, Apart, Blinded, Misled, config, mapped, prior_of, walk

from emgs_jax import load_map
from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.geometry import pose_difference
from emgs_jax.localization import LEAST_NOISE
from emgs_jax.mapping.run import MappingRun
from emgs_jax.runs.files import save_progress
from emgs_jax.runs.metrics import score_back_end

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("smoke")]
MAX_DISTANCE, MAX_TURN = 0.05, 2.0  # the bar, where the prior errs; here it is exact
MAX_ADDED = 0.02  # rad, by which it and the map may differ


def assert_near(records) -> None:
    for record in records:
        distance, turn = pose_difference(record.pose, record.true_pose)
        assert distance <= MAX_DISTANCE and turn <= MAX_TURN, record.index


@cache
def kidnapped() -> MappingRun:
    frames = walk((*THERE, *BACK))
    return mapped(frames, Blinded(prior_of(frames), len(THERE)))


def test_a_camera_that_was_carried_off_comes_back():
    run, patience, noise = kidnapped(), config().graph.relocalization.patience, config().graph.noise
    first = len(THERE)
    back = first + patience - 1
    assert all(record.location is None for record in run.records[:back])
    lost = [record.status for record in run.records[first:back]]
    assert set(lost) <= {"degraded", "lost"}, "nothing leads from the frames before to these"
    assert [record.location for record in run.records[back:]] == ["relocalized", None, None]
    assert [record.status for record in run.records[back:]] == ["tracked"] * 3
    assert_near(run.records[back:])
    assert score_back_end(run)["location/relocalized"] == 1
    end = run.back_end
    assert end.connected_since == back and not end.nodes[first].is_placed
    assert not any(edge.a >= end.connected_since > edge.b and edge.b >= first for edge in end.factors), (
        "lost frames hold nothing"
    )
    chain = [edge for edge in end.factors if edge.a == edge.b + 1 and edge.sqrt_info[6, 6]]  # none by the map
    assert {end.nodes[edge.a].is_placed for edge in chain} == {True, False}
    for edge in chain:
        record, is_placed = run.records[edge.a], end.nodes[edge.a].is_placed
        told = max(record.depth_noise, LEAST_NOISE) if is_placed else noise.depth
        # What the exact prior and the map differ by is added; of a lost frame few points fit exactly.
        assert 0.9999 <= 1 / (edge.sqrt_info[5, 5] * told * noise.pair) <= 1.0001 + is_placed * MAX_ADDED / told


NOWHERE = (NEVER_FOUND, "graph.min_violation=1e9", "graph.relocalization.max_patience=4")


@pytest.mark.weekly
def test_the_map_goes_on_where_the_prior_leads_when_the_camera_is_found_nowhere():
    """And it is right relative to the frame where it began anew, as the prior is; the frames before stay."""
    frames, cut = walk((*THERE[:5], *range(1, 17, 2))), 5
    run = mapped(frames, Misled(prior_of(frames), cut), words=NOWHERE)
    anew = cut + 3
    assert [record.status for record in run.records[cut:anew]] == ["degraded"] * 3
    assert [record.location for record in run.records[anew:]] == ["restarted"] + [None] * 4
    first = run.records[anew]
    assert first.status == "initialization" and first.new > 0 and first.reason is not None
    assert [record.status for record in run.records[anew + 1 :]] == ["tracked"] * 4
    for row, record in enumerate(run.records):
        start = run.records[0]
        path = np.linalg.inv(start.true_pose) @ record.true_pose
        assert max(pose_difference(record.pose, start.pose @ (path if row < cut else Misled.motion @ path))) < 0.02, row
    births = np.asarray(run.map.birth)[np.asarray(run.map.gaussians.valid)]
    assert np.sum(births == anew) > first.new // 2  # some were joined with later ones
    assert not np.any((births >= cut) & (births < anew))
    assert [node.is_placed for node in run.back_end.nodes] == [True] * cut + [False] * 3 + [True] * 5


@pytest.mark.weekly
def test_nothing_begins_anew_where_nothing_leads():
    """The prior knows nothing of the frames before: where these are relative to the map is not known."""
    frames = walk((*THERE[:5], *range(1, 17, 2)))
    run = mapped(frames, Blinded(prior_of(frames), 5), words=NOWHERE)
    assert {record.status for record in run.records[5:]} <= {"degraded", "lost"}
    assert "restarted" not in {record.location for record in run.records}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, frames = tmp_path_factory.mktemp("saved"), walk(THERE)
    save_progress(folder, mapped(frames, prior_of(frames)))
    (folder / "metrics.json").write_text("{}")  # a finished run's
    return folder


def loaded(folder, mode: str):
    return load_saved_map(str(folder), mode, config().graph, walk(BACK).intrinsics, 0.01)


def assert_only_located(run: MappingRun, folder) -> None:
    """The saved map stays as it is."""
    assert_same(jax.device_get(run.map), jax.device_get(load_map(folder / "map.npz")))
    assert len(run.back_end.poses) == len(THERE) and {record.new for record in run.records} <= {0, None}


@pytest.mark.parametrize(("cut", "back"), [(4, 6), pytest.param(0, 1, marks=pytest.mark.weekly)])
def test_a_prior_that_goes_on_in_a_frame_of_its_own_is_located_in_a_saved_map_that_stays_as_it_is(folder, cut, back):
    """Symptom: every frame of it was refused, because it had no pose in the world from before."""
    frames = walk((*BACK, 17, 19, 18))
    run = mapped(frames, Apart(prior_of(frames, "prior.seed=7"), (cut,), (1.0, 1.05)), loaded(folder, "localize"))
    tracked = [record for record in run.records if not cut <= record.index < back]
    assert {record.status for record in tracked} == {"tracked"}
    assert_near(tracked)
    assert_only_located(run, folder)


@pytest.mark.weekly
def test_frames_are_located_in_a_saved_map_and_it_stays_as_it_is(folder):
    frames = walk(BACK)
    run = mapped(frames, prior_of(frames, "prior.seed=7"), loaded(folder, "localize"))
    assert run.records[0].location == "relocalized" and {record.status for record in run.records} == {"tracked"}
    assert_near(run.records)
    assert_only_located(run, folder)


def test_a_run_goes_on_in_a_saved_map_and_can_be_saved_itself(folder, tmp_path):
    frames = walk(BACK)
    run = mapped(frames, prior_of(frames, "prior.seed=7"), loaded(folder, "extend"))
    end = run.back_end
    assert (
        run.records[0].location == "relocalized"
        and len(end.poses) == len(THERE) + len(BACK)
        and end.first_node == len(THERE)
    )
    assert_near(run.records)
    assert int(run.state.time) == len(end.poses)
    saved = loaded(folder, "extend").map
    assert int(run.map.num_updates.sum()) > int(saved.num_updates.sum()), "what is seen again is fused into that map"
    new = [edge for edge in end.factors if edge.a >= end.first_node]
    assert any(edge.b < end.first_node for edge in new), "the new frames hang on those that the map was made from"
    assert all(edge.sqrt_info[6, 6] == 0 for edge in new if edge.b < end.first_node), "by the map: no window has both"
    noise = config().graph.noise
    for edge in new:
        told = max(run.records[edge.a - end.first_node].depth_noise, LEAST_NOISE)
        angle = noise.pair if edge.sqrt_info[6, 6] else noise.map
        known = end.nodes[edge.b].predicted is not None
        assert 0.9999 <= 1 / (edge.sqrt_info[5, 5] * told * angle) <= 1.0001 + known * MAX_ADDED / told, (
            "as sure as its frame's depths, and as the prior and the map agree"
        )
    save_progress(tmp_path, run)
    (tmp_path / "metrics.json").write_text("{}")
    again = loaded(tmp_path, "extend")
    assert again.back_end.first_node == len(THERE) + len(BACK)
    assert_same(jax.device_get(again.map), jax.device_get(run.map))


def test_images_of_another_place_are_not_found_and_the_run_says_so(folder):
    other = walk(BACK, "dataset.seed=5")
    with pytest.raises(ValueError, match=r"none of the 5 frames is found in the saved map \(.*matches"):
        mapped(other, prior_of(other), loaded(folder, "localize"))
