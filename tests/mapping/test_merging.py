"""Finished runs become one: two laps of two cameras, in two units; what shares nothing; and twin rooms."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from walks import Edited, config, mapped, prior_of, settings, walk

import experiments.run
from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.config.configure import build_prior
from emgs_jax.geometry import pose_difference
from emgs_jax.mapping.atlas import Atlas
from emgs_jax.mapping.merging import join
from emgs_jax.prior.base import PriorPrediction
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.merging import merge
from experiments.merge import merge_runs

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("smoke")]
UNIT = 1.25  # of the second run: what its prior gives as that is a metre
LOOPS = ("prior.level=1", "prior.version=2", "graph.place_recognition.min_gap=8")
FIRST = (*LOOPS, "dataset.stride=4")
SECOND = (*LOOPS, "dataset.stride=4", "dataset.start=2", "dataset.size=[200,150]", "prior.seed=7")


class Scaled(Edited):
    """A prior with another unit."""

    def _edit(self, found: PriorPrediction) -> PriorPrediction:
        poses = found.T_anchor_view.copy()
        poses[:, :3, 3] *= UNIT
        return replace(found, T_anchor_view=poses, points=np.float32(UNIT) * found.points)


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder with both laps, and both merged."""
    folder, patched = tmp_path_factory.mktemp("runs"), pytest.MonkeyPatch()

    def run(name: str, *words: str) -> None:
        (folder / name).mkdir()
        experiments.run.run(settings(*words), folder / name)

    run("first", *FIRST)
    patched.setattr(experiments.run, "build_prior", lambda config, frames: Scaled(build_prior(config, frames)))
    run("second", *SECOND)
    patched.undo()
    merge([folder / "first", folder / "second"], folder / "both")
    return folder


def metrics_of(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.weekly  # two whole runs and a third of both: three minutes
def test_two_laps_of_two_cameras_in_two_units_become_one_map_that_is_better_than_each(runs):
    first, second, both = (metrics_of(runs / name) for name in ("first", "second", "both"))
    assert both["trajectory/num_frames"] == both["frames/tracked"] + 2 == 40 and both["submaps/unjoined_frames"] == 0
    assert both["loops/accepted"] > 10 and both["loops/precision"] == 1
    paths = [one["trajectory/ate_sim3_m"] for one in (first, second)]
    assert both["trajectory/ate_sim3_m"] < np.mean(paths)
    assert abs(np.log(both["trajectory/scale"] / first["trajectory/scale"])) < 0.03
    for one in (first, second):
        assert both["reconstruction_icp/f1_5cm_percent"] > one["reconstruction_icp/f1_5cm_percent"] + 2
    walls = [one["map/double_wall_percent"] for one in (first, second)]
    assert both["map/double_wall_percent"] < 1.5 * np.mean(walls), "two maps that only lie on each other have 2.2 times"
    assert both["map/num_gaussians"] < 0.8 * sum(one["map/num_gaussians"] for one in (first, second)), "both saw it"


@pytest.mark.weekly
def test_a_merged_run_is_a_run_like_any_other_in_the_world_of_the_first(runs):
    first, both = (read_run(runs / name) for name in ("first", "both"))
    distance, _ = pose_difference(both.poses[:20], first.poses)
    assert distance.max() < 0.1
    assert [line["index"] for line in both.frames] == list(range(40))
    dataset, note = images_of(both)
    assert not note and dataset.size == (160, 120) and len(dataset) == 40
    assert (runs / "both" / "report.html").exists()
    assert any(loop["outcome"] == "accepted" and loop["other"] < 20 <= loop["frame"] for loop in both.loops)
    saved = load_saved_map(
        str(runs / "both"), "extend", config(*LOOPS).graph, first.provenance["data"]["frames"]["intrinsics"], 0.01
    )
    assert saved.back_end.first_node == 40 and saved.count >= metrics_of(runs / "both")["map/num_gaussians"]


@pytest.mark.weekly
def test_what_the_records_say_of_other_poses_and_frames_is_in_the_world_and_the_numbers_of_the_merged_run(runs):
    """Symptom: the raw path and the origins of the second run were in its own world, unit and numbers."""
    second, both = (read_run(runs / name) for name in ("second", "both"))
    for own, line in zip(second.frames, both.frames[20:], strict=True):
        assert line["origin"] == (None if own["origin"] is None else own["origin"] + 20)
    np.testing.assert_allclose(second.raw[0], second.poses[0], atol=1e-6)
    np.testing.assert_allclose(both.raw[20], both.poses[20], atol=1e-6)
    own, moved = (np.linalg.norm(np.diff(raw[:, :3, 3], axis=0), axis=1) for raw in (second.raw, both.raw[20:]))
    np.testing.assert_allclose(moved / own, 1 / UNIT, rtol=0.05)
    distance, turn = pose_difference(both.raw[20:], both.poses[20:])
    assert distance.max() < 0.2 and turn.max() < 5


@cache
def atlas(numbers: tuple[int, ...], *words: str) -> Atlas:
    frames = walk(numbers, *words)
    return mapped(frames, prior_of(frames, *words), words=words).atlas


def test_two_walks_past_the_same_things_become_one_map_along_the_true_path():
    """The prior is exact, in a unit that is not that of the first for the second."""
    one = atlas(tuple(range(0, 24, 2)))
    frames = walk(range(1, 25, 2))
    found = join(one, mapped(frames, Scaled(prior_of(frames))).atlas)
    assert isinstance(found, Atlas), found
    truth = np.stack([frame.T_world_camera for part in (walk(range(0, 24, 2)), frames) for frame in part])
    poses = np.stack([node.pose for node in found.graph.nodes])
    assert pose_difference(poses, poses[0] @ np.linalg.inv(truth[0]) @ truth)[0].max() < 0.05
    alone, both = (int(part.state.map.gaussians.valid.sum()) for part in (one, found))
    assert alone < both < 1.7 * alone, "one layer, where both saw it"


def test_images_that_both_maps_have_join_them_where_no_place_is_recognized():
    """No image has a keypoint; the other prior has another unit."""
    words = ("graph.place_recognition.min_contrast=1",)
    one, frames = atlas(tuple(range(0, 16, 2)), *words), walk(range(10, 26, 2), *words)
    other = mapped(frames, Scaled(prior_of(frames, *words)), words=words).atlas
    assert "no keyframe shows the same place" in join(one, other)
    found = join(one, other, [(5, 0), (6, 1), (7, 2)])
    assert isinstance(found, Atlas), found
    truth = np.stack([frame.T_world_camera for part in (walk(range(0, 16, 2)), frames) for frame in part])
    poses = np.stack([node.pose for node in found.graph.nodes])
    assert pose_difference(poses, poses[0] @ np.linalg.inv(truth[0]) @ truth)[0].max() < 0.02
    scales = np.array([node.log_scale for node in found.graph.nodes])
    np.testing.assert_allclose(scales[8:] - scales[:8].mean(), -np.log(UNIT), atol=0.02)


TWINS = ("dataset=apartment", "dataset.walk=twin_rooms", "dataset.num_frames=null", "dataset.stop=null")


@pytest.mark.parametrize(
    ("one", "other", "words", "reason"),
    [
        (range(0, 10, 2), range(60, 50, -2), (), "no keyframe shows the same place"),
        pytest.param(range(0, 240, 10), range(290, 530, 10), TWINS, "see", marks=pytest.mark.weekly),
    ],
)
def test_what_is_not_one_place_is_not_joined(one, other, words, reason):
    found = join(*(atlas(tuple(numbers), *words) for numbers in (one, other)))
    assert isinstance(found, str) and reason in found


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("folders", "out", "message"),
    [
        (["first"], "new", "give two or more"),
        (["first", "first"], "new", "named twice"),
        (["first", "."], "new", "holds no finished run"),
        (["first", "nowhere"], "new", "is no folder"),
        (["first", "second"], "both", "is there already"),
        (["first", "bare"], "new", "map it again with graph=default"),
    ],
)
def test_what_cannot_be_merged_is_refused_with_a_remedy(runs, folders, out, message):
    bare = runs / "bare"
    if not bare.exists():
        bare.mkdir()
        for path in (runs / "first").iterdir():
            if path.is_file() and path.name != "places.npz":
                (bare / path.name).symlink_to(path)
    given = {"folders": [str(runs / name) for name in folders], "out": str(runs / out), "truth": True}
    with pytest.raises(ValueError, match=message):
        merge_runs(OmegaConf.create(given))
