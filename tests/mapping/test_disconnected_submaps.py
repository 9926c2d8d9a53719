"""Parts of a run without a relation; oracles: true poses and surfaces, similarities by hand, bits of other runs."""

from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scene import assert_same
from scipy.spatial import cKDTree
from walks import NEVER_FOUND, Apart, Visited, config, mapped, prior_of, same_run, walk

from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.data.base import Frame
from emgs_jax.geometry import Sim3, pose_difference
from emgs_jax.io.map_file import load_map
from emgs_jax.loop_closure.relocalization import RelocalizedPose
from emgs_jax.mapping.atlas import join_factor
from emgs_jax.mapping.checkpoint import CheckpointConfig, Keeper
from emgs_jax.mapping.records import APART, UNJOINED
from emgs_jax.mapping.run import MappingRun
from emgs_jax.runs.files import save_progress
from emgs_jax.runs.metrics import describe, score_back_end

pytestmark = pytest.mark.xdist_group("smoke")

# Frames of the path. The last part begins where it sees the first, and walks on to where it sees the second.
PARTS = (0, 2, 4, 6, 8), (60, 58, 56, 54, 52), (4, 2, 0, 78, 75, 72, 69, 66, 63, 60, 57)
UNITS = (1.0, 1.25, 0.8)  # of the parts: what the prior gives there as that is a metre
WHOLE, STARTS = sum(PARTS, ()), (5, 10)
PART = np.repeat(range(3), [len(part) for part in PARTS])


def ran(numbers, starts, *words: str, **more) -> MappingRun:
    frames = walk(numbers)
    return mapped(frames, Apart(prior_of(frames), starts, UNITS), words=words, **more)


@cache
def apart(numbers, starts, *words: str) -> MappingRun:
    return ran(numbers, starts, *words)


@pytest.mark.slow
def test_parts_of_other_frames_and_units_are_joined_where_they_meet_the_map():
    """The last part is joined with the first, so it moves; then both meet the second, so that one moves."""
    run = apart(WHOLE, STARTS)
    end, said = run.back_end, [record.location for record in run.records]
    assert [row for row, location in enumerate(said) if location == "new_submap"] == list(STARTS)
    one, other = (row for row, location in enumerate(said) if location == "joined")
    assert STARTS[1] < one < other and "restarted" not in said, "the prior knows the motion from 0 to 78"
    for node, record in zip(end.nodes, run.records, strict=True):
        for found in (node.pose, node.online, record.pose):
            distance, turn = pose_difference(found, record.true_pose)
            assert distance < 0.03 and turn < 1.0, record.index
    np.testing.assert_allclose(np.exp(end.log_scales), 1 / np.array(UNITS)[PART], rtol=0.02)
    np.testing.assert_allclose(Sim3.from_matrix(run.records[one].similarity).scale, 1 / UNITS[2], rtol=0.02)
    np.testing.assert_allclose(Sim3.from_matrix(run.records[other].similarity).scale, UNITS[1], rtol=0.02)
    assert not run.apart and {node.submap for node in end.nodes} == {0}
    metrics = score_back_end(run)
    assert metrics["location/new_submap"] == metrics["location/joined"] == 2


@pytest.mark.slow
def test_what_was_mapped_apart_lies_on_the_true_surfaces_after_it_is_joined():
    run, frames = apart(WHOLE, STARTS), walk(WHOLE)
    truth = cKDTree(np.concatenate([surface(frames[row]) for row in range(len(frames))]))
    births, valid = np.asarray(run.map.birth), np.asarray(run.map.gaussians.valid)
    for born in (range(5), range(5, 10), range(10, 12), range(12, len(WHOLE))):
        means = np.asarray(run.map.gaussians.means)[valid & np.isin(births, born)]
        distance, _ = truth.query(means)
        assert len(means) > 15 and np.median(distance) < 0.03 and np.quantile(distance, 0.9) < 0.08, born


def surface(frame: Frame) -> np.ndarray:
    """Points (n, 3) of the true depth, world."""
    fx, fy, cx, cy = walk(WHOLE).intrinsics
    y, x = np.nonzero(frame.depth > 0)
    z = frame.depth[y, x]
    points = np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], axis=1)
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "stop"),
    [((), 7), *(pytest.param(*case, marks=pytest.mark.weekly) for case in (((), 13), ((NEVER_FOUND,), 12)))],
)
def test_a_run_that_is_stopped_in_a_part_or_after_it_was_joined_has_the_same_bits(tmp_path, words, stop):
    keep = lambda: Keeper(tmp_path / "checkpoint.npz", CheckpointConfig(every=1000), {})  # noqa: E731
    ran(WHOLE, STARTS, *words, keeper=keep(), stop=stop)
    keeper = keep()
    assert keeper.found is not None and len(keeper.found.records) == stop and len(keeper.found.atlas.submaps) > 1
    same_run(ran(WHOLE, STARTS, *words, keeper=keeper), apart(WHOLE, STARTS, *words))


@pytest.mark.slow
@pytest.mark.parametrize("num_before", [4, pytest.param(9, marks=pytest.mark.weekly)])
def test_of_parts_that_never_meet_the_one_with_most_placed_frames_is_the_map(tmp_path, num_before):
    numbers = (*range(0, 2 * num_before, 2), *range(26, 14, -2))
    (tmp_path / "frames.jsonl").write_text(
        '{"index": 99, "status": "skipped", "covariance": null}\n'
        + "".join(
            f'{{"index": {row}, "status": "tracked", "reason": null, "pose": [1], "covariance": null}}\n'
            for row in range(len(numbers))
        )
    )
    run = apart(numbers, (num_before,), NEVER_FOUND)
    kept = range(num_before) if num_before > 6 else range(num_before, num_before + 6)
    for row, record in enumerate(run.records):
        assert (record.status == APART and record.reason == UNJOINED) == (row not in kept), row
        assert (record.submap is None) == (row in kept)
    births = np.asarray(run.map.birth)[np.asarray(run.map.gaussians.valid)]
    assert len(births) > 0 and set(births) <= set(kept)
    assert [node.is_placed for node in run.back_end.nodes] == [row in kept for row in range(len(numbers))]
    assert {edge.a for edge in run.back_end.factors} <= set(kept)
    assert {one.frame for one in run.back_end.database.keyframes} == set(kept[1:])  # the first opened the map
    save_progress(tmp_path, run)
    lines = (tmp_path / "frames.jsonl").read_text().splitlines()
    assert "skipped" in lines[0]
    assert [UNJOINED in line for line in lines[1:]] == [row not in kept for row in range(len(numbers))]
    (tmp_path / "metrics.json").write_text("{}")
    (number,) = run.apart
    (folder,) = (tmp_path / "submaps").iterdir()
    assert folder.name == str(number)
    assert_same(jax.device_get(load_map(folder / "map.npz")), jax.device_get(run.apart[number].map))
    assert len((folder / "trajectory.txt").read_text().splitlines()) == 1 + len(numbers) - len(kept)
    metrics = describe(run, SimpleNamespace(skipped={}, kept=range(len(numbers))))
    assert metrics["frames/apart"] == metrics[f"submaps/{number}/frames"] == len(numbers) - len(kept)
    assert metrics[f"submaps/{number}/ate_sim3_m"] < 0.03
    saved = load_saved_map(str(tmp_path), "extend", config().graph, run.back_end.intrinsics, 0.01)
    assert_same(jax.device_get(saved.map), jax.device_get(run.map))


@pytest.mark.slow
def test_a_world_that_comes_back_goes_on_in_its_submap():
    """Oracle: the true poses of the first world's frames, those after the other world included."""
    numbers = (*PARTS[0], *PARTS[1], 10, 12, 14, 16)
    frames, is_first = walk(numbers), [row not in range(5, 10) for row in range(len(numbers))]
    run = mapped(frames, Visited(prior_of(frames), (5, 10), UNITS), words=(NEVER_FOUND,))
    assert [row for row, record in enumerate(run.records) if record.location == "new_submap"] == [5]
    assert [record.status == APART for record in run.records] == [not first for first in is_first]
    for row in np.flatnonzero(is_first):
        distance, turn = pose_difference(run.records[row].pose, run.records[row].true_pose)
        assert distance < 0.03 and turn < 1.0, row
    births = {*np.asarray(run.map.birth)[np.asarray(run.map.gaussians.valid)].tolist()}
    assert births & {0, 1, 2, 3, 4} and births & {10, 11, 12, 13} and not births & {5, 6, 7, 8, 9}


@pytest.mark.slow
def test_without_a_back_end_frames_without_a_relation_are_lost_as_those_of_which_nothing_is_known():
    frames = walk((*PARTS[0], *PARTS[1][:3]))
    runs = [
        mapped(frames, Apart(prior_of(frames), STARTS[:1], UNITS, is_silent), words=("graph=none",))
        for is_silent in (False, True)
    ]
    assert [record.status for record in runs[0].records[5:]] == ["lost"] * 3
    assert_same(*(jax.device_get(run.map) for run in runs))
    np.testing.assert_array_equal(*(run.poses for run in runs))


def test_what_holds_two_parts_together_is_as_sure_as_the_place_was_in_its_unit_then():
    """The place was found to 1 cm in the map as it was then, whichever of the two has moved since."""
    poses, unit, scales = np.tile(np.eye(4), (3, 1, 1)), 0.4, (0.1, np.log(2.0), np.log(3.0))
    poses[2, :3, 3] = 1.0, 2.0, 3.0
    nodes = [Node(pose, pose, scale, row) for row, (pose, scale) in enumerate(zip(poses, scales, strict=True))]
    end = BackEnd(config().graph, (300.0, 300.0, 160.0, 120.0), 0.0, nodes)
    edge = join_factor(end, RelocalizedPose(np.eye(4), 0.0, 1e-4 * np.eye(7), 1), unit)
    assert (edge.a, edge.b) == (1, 2) and edge.log_ratio == pytest.approx(np.log(1.5))
    np.testing.assert_allclose(edge.Z_a_b[:3, 3], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(edge.sqrt_info, np.diag([100.0 * unit] * 3 + [100.0] * 4))
