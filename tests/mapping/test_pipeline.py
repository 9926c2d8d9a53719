"""Streaming, bad predictions and records; the prior is exact, so the truth is the oracle."""

from collections import Counter
from dataclasses import replace

import hydra
import jax
import numpy as np
import pytest
from scene import same_bits, slam_config
from tiny_run import NUM_FRAMES, WINDOW_SIZE, EditedPrior, at_inference, compose, dataset, exact, map_tiny

from emgs_jax.config.configure import build
from emgs_jax.data.base import Dataset
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.spool import Spool
from emgs_jax.device.clock import Clock
from emgs_jax.mapping import pipeline
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.run import check_settings, clamped, new_run
from emgs_jax.mapping.window_input import predictions, window_inputs
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import Prior
from emgs_jax.runs.dense import dense_map
from emgs_jax.runs.files import save_outputs
from emgs_jax.runs.gathering import RawPrior
from emgs_jax.runs.metrics import new_scorer, score_map, score_prior

pytestmark = pytest.mark.xdist_group("tiny")


class Counting(Dataset):
    """A data set that counts how often each frame is read."""

    def __init__(self, num_frames: int) -> None:
        self.num_frames, self.reads, self.intrinsics = num_frames, Counter(), (1.0, 1.0, 0.0, 0.0)

    def __len__(self) -> int:
        return self.num_frames

    def __getitem__(self, index: int) -> int:
        self.reads[index] += 1
        return index


class Echo(Prior):
    """Answers with the frames that it was given."""

    def predict(self, window, frames, intrinsics):
        return window, frames


def test_a_run_in_float64_is_refused_before_its_first_frame():
    """A notebook with JAX_ENABLE_X64=1 ended in "Incompatible shapes for broadcasting", after compiling."""
    data, config = dataset(), build(compose(), "slam")
    with jax.enable_x64(True), pytest.raises(ValueError, match="JAX_ENABLE_X64 is set, and maps are made in float32"):
        new_run(data, config)
    assert new_run(data, config).camera.width == data.size[0]


def test_each_frame_is_read_once_just_before_it_is_needed_and_kept_only_while_a_window_holds_it():
    frames, size = Counting(20), 4
    for (window, given), held in predictions(frames, Echo(), size, Clock()):
        assert tuple(given) == window.views == tuple(held)
        assert len(held) <= size + 3 and max(frames.reads) == max(window.views), "nothing may be read ahead"
    assert set(frames.reads) == set(range(20)) and set(frames.reads.values()) == {1}


@pytest.mark.parametrize("window", [WINDOW_SIZE, pytest.param(1, marks=pytest.mark.slow)])
def test_every_frame_has_one_record_with_its_true_pose_where_the_prior_is_exact(window):
    run, _ = exact() if window == WINDOW_SIZE else map_tiny(dataset(), EditedPrior(), f"slam.window_size={window}")
    assert [record.index for record in run.records] == list(range(NUM_FRAMES))
    assert [record.status for record in run.records] == ["initialization"] + ["tracked"] * (NUM_FRAMES - 1)
    truth = np.stack([dataset()[i].T_world_camera for i in range(NUM_FRAMES)])
    np.testing.assert_allclose(run.poses, truth, atol=1e-3)  # a tenth of the bar
    np.testing.assert_allclose(run.raw_poses, truth, atol=1e-12)
    for record, following in zip(run.records[1:], truth[2:], strict=False):
        if record.index + 1 != window:  # the last view of the first window has no image after it
            np.testing.assert_allclose(record.newest_pose[:3, 3], following[:3, 3], atol=1e-3)


@pytest.mark.parametrize(
    "damages",
    [
        {1: {"points": np.nan}, 2: {"T_anchor_view": np.nan}},
        {1: {"mask": False}, 2: {"confidence": np.nan}, 3: {"confidence": 0.0}},
    ],
)
def test_predictions_without_a_valid_point_or_pose_mark_their_frames_and_leave_the_map_bit_identical(damages):
    def edit(prediction):
        for number, arrays in damages.items():
            prediction = at_inference(number, **arrays)(prediction)
        return prediction

    run, maps = map_tiny(dataset(), EditedPrior(edit))
    for number in damages:
        bad = WINDOW_SIZE - 1 + number
        record = run.records[bad]
        has_pose = "T_anchor_view" not in damages[number]
        assert record.status == ("degraded" if has_pose else "lost") and "no valid point or pose" in record.reason
        assert same_bits(maps[bad], maps[bad - 1])
    assert (run.records[-1].status == "tracked") == (3 not in damages), "the frame after them is as all are"
    assert np.isfinite(run.poses).all() and np.isfinite(run.raw_poses).all()
    gaussians = run.state.map.gaussians
    assert np.isfinite(np.asarray(gaussians.means)[np.asarray(gaussians.valid)]).all()


@pytest.mark.parametrize("damaged", ["points", "T_anchor_view"])
def test_a_bad_view_in_the_first_window_is_not_tracked_and_the_others_are(damaged):
    def edit(prediction):
        if prediction.window.inference == 0:
            getattr(prediction, damaged)[1] = np.nan
        return prediction

    run, maps = map_tiny(dataset(), EditedPrior(edit))
    assert [record.status for record in run.records[:3]] == [
        "initialization",
        "degraded" if damaged == "points" else "lost",
        "tracked",
    ]
    assert same_bits(maps[0], maps[1])
    found, truth = run.poses[2:], [dataset()[i].T_world_camera for i in range(2, NUM_FRAMES)]
    # The chain is broken, the prior's own pose is not; but how good it is nobody knows, so the tiny map pulls at it.
    np.testing.assert_allclose(found, truth, atol=0.05)


def test_a_view_without_a_pose_cannot_be_merged():
    def edit(prediction):
        prediction.T_anchor_view[1] = np.nan
        return prediction

    with pytest.raises(ValueError, match="slam.initialization=incremental"):
        map_tiny(dataset(), EditedPrior(edit), "slam.initialization=merged")


@pytest.mark.parametrize("num_empty", [pytest.param(1, marks=pytest.mark.weekly), WINDOW_SIZE + 1])
def test_the_map_starts_at_the_first_frame_with_a_point_and_those_before_are_lost(num_empty):
    """All later frames were degraded, the map stayed empty and nothing said so."""

    def edit(prediction):
        for row, index in enumerate(prediction.window.dense):
            if index < num_empty:
                prediction.mask[row] = False
        return prediction

    run, _ = map_tiny(dataset(), EditedPrior(edit))
    expected = ["lost"] * num_empty + ["initialization"] + ["tracked"] * (NUM_FRAMES - num_empty - 1)
    assert [record.status for record in run.records] == expected
    assert [record.index for record in run.records] == list(range(NUM_FRAMES))
    truth = [dataset()[i].T_world_camera for i in range(NUM_FRAMES)]
    np.testing.assert_allclose(run.poses[num_empty:], truth[num_empty:], atol=5e-3)
    np.testing.assert_array_equal(run.poses[:num_empty], [truth[0]] * num_empty)


def test_a_prior_without_any_point_is_an_error_and_not_a_run_that_never_maps():
    with pytest.raises(ValueError, match="none of the .* frames of .*dataset.stride"):
        map_tiny(dataset(), EditedPrior(lambda prediction: replace(prediction, mask=prediction.mask & False)))


def test_a_map_that_begins_without_a_gaussian_names_the_frame_and_the_points(monkeypatch):
    """A map without a Gaussian was said to be of a prior without a point."""
    monkeypatch.setattr(pipeline, "prepare_step", lambda *_: None)  # of a step, which there is not

    def with_few(prediction):
        few = np.zeros(prediction.mask.shape[1:], bool)
        few[[20, 20, 21], [20, 21, 20]] = True  # a Gaussian takes four
        return replace(prediction, mask=prediction.mask & few)

    with pytest.raises(ValueError, match=r"of 3 valid points none become a Gaussian; begin elsewhere"):
        map_tiny(dataset(), EditedPrior(with_few))


def test_a_sequence_without_frames_is_refused():
    empty = Counting(0)
    empty.name, empty.sequence = "nothing", ""
    with pytest.raises(ValueError, match="none of the 0 frames of nothing"):
        list(window_inputs(empty, Echo(), hydra.utils.instantiate(compose().slam), Clock()))


def test_the_merged_initialization_makes_the_map_from_the_whole_window(monkeypatch):
    """Only the first window: `initialization` is static, so a step would be compiled anew."""
    monkeypatch.setattr(pipeline, "prepare_step", lambda *_: None)  # of a step, which there is not
    frames = ReadableFrames(hydra.utils.instantiate(compose(f"dataset.stop={WINDOW_SIZE}").dataset))
    run, maps = map_tiny(frames, EditedPrior(), "slam.initialization=merged")
    assert [record.status for record in run.records] == ["initialization"] * WINDOW_SIZE
    truth = np.stack([frame.T_world_camera for frame in map(dataset().__getitem__, range(WINDOW_SIZE))])
    np.testing.assert_allclose(run.poses, truth, atol=1e-5)
    assert len(maps) == WINDOW_SIZE and maps[0].gaussians.valid.sum() == run.records[-1].num_gaussians > 100


def test_without_ground_truth_everything_but_metrics_comes_out(tmp_path):
    run, _ = exact()
    blind = replace(run, records=tuple(replace(record, true_pose=None) for record in run.records))
    config = hydra.utils.instantiate(compose().densify)
    protocol = hydra.utils.instantiate(compose().evaluation)
    dense = dense_map(blind, dataset(), config, protocol)
    assert len(dense.cloud) > 1000 and len(dense.pictures) == 4
    assert save_outputs(tmp_path, blind, dense, config, "blind", True) == []
    names = {"map.ply", "points.ply", "mesh.ply", "overview.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    scorer = new_scorer(dataset(), protocol, EditedPrior(), True)
    raw = RawPrior(dense.cloud, Spool())
    assert score_map(blind, dense.cloud, dense.cloud, None, scorer) == score_prior(blind, raw, scorer) == {}
    assert dense.rendering == {}


def test_the_map_does_not_start_at_the_origin_but_at_the_first_true_pose_and_at_the_identity_without_one():
    class Blind(ReadableFrames):
        def __getitem__(self, index):
            return replace(super().__getitem__(index), T_world_camera=None)

    class Knowing(EditedPrior):
        def predict(self, window, frames, intrinsics):
            return super().predict(window, [dataset()[index] for index in window.views], intrinsics)

    run = new_run(Blind(dataset()), exact()[0].config)
    *_, (run, _, _) = map_frames(run, Blind(dataset()), Knowing())
    run = finish_run(run)
    origin = np.linalg.inv(dataset()[0].T_world_camera)
    expected = np.stack([origin @ pose for pose in exact()[0].poses])
    np.testing.assert_allclose(run.poses, expected, atol=1e-3)
    assert run.true_poses == [None] * NUM_FRAMES


@pytest.mark.parametrize(("given", "is_said"), [(8, True), (20, True), (169, False), (200, False)])
def test_a_setting_that_images_of_this_size_bound_is_named(given, is_said):
    """λ of 20 and of 8 made one map of images of 160×120, without a word."""
    config = slam_config("slam.observation.thin=2", f"slam.fit.points_per_gaussian={given}")
    said = clamped(config, Camera([150.0, 150.0], [79.5, 59.5], 160, 120))
    assert bool(said) == is_said and all(f"points_per_gaussian={given} makes the Gaussians of 169" in x for x in said)
    (both,) = clamped(
        slam_config("slam.em.num_neighbours=16", "slam.em.num_candidates=8"),
        Camera([150.0] * 2, [79.5, 59.5], 640, 480),
    )
    assert "num_candidates=8" in both


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["slam/existence=default", "slam.existence.max_log_odds=0"], "no Gaussian would ever be confirmed"),
        (["slam/existence=default", "slam.existence.hit=0"], "no Gaussian would ever be confirmed"),
        (["slam/existence=paper", "slam.existence.birth=0"], "no Gaussian would ever be confirmed"),
        (
            ["slam.existence.birth=1", "slam.existence.miss=.1", "slam.existence.max_log_odds=0"],
            "would ever be confirmed",
        ),
        (["slam/existence=default", "slam.existence.refuted=.6"], "every Gaussian would be removed"),
        (["slam/existence=paper", "slam.existence.refuted=1.5"], "every Gaussian would be removed"),
        (["slam/motion=default", "slam.motion.prior=-inf"], "taken for moving, and no frame be tracked"),
        (["slam/motion=default", "slam.motion.prior=-2"], "taken for moving, and no frame be tracked"),
        (["slam.localization.max_step=0"], r"slam\.localization\.max_step=0 lets no frame pass"),
        (["slam.localization.max_pose_std=0"], r"slam\.localization\.max_pose_std=0 lets no frame pass"),
        (["slam.localization.icp.max_mahalanobis_sq=0"], r"icp\.max_mahalanobis_sq=0 lets no frame pass"),
        (["slam.fit.points_per_gaussian=203057"], "makes no Gaussian of an image"),
    ],
)
def test_settings_by_which_nothing_could_be_tracked_are_refused_with_the_reason(words, message):
    """Symptom: all frames after the first were lost, and nothing said why."""
    with pytest.raises(ValueError, match=message):
        check_settings(slam_config(*words))


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["slam/existence=paper", "slam.existence.max_log_odds=0"],  # as printed, where the log-odds never change
        ["slam/existence=default", "slam/motion=default"],
        ["slam.motion.prior=-inf"],  # where nothing is looked for
        ["slam/motion=default", "slam.motion.prior=-1"],
        ["slam.fit.points_per_gaussian=203056"],
    ],
)
def test_settings_by_which_frames_are_tracked_are_taken(words):
    check_settings(slam_config(*words))
