"""What is gathered while a run grows; oracle: a wall at z = 2 that the prior sees in a place and size of its own."""

from types import SimpleNamespace

import numpy as np
import pytest
from hand_run import poses_along
from scene import evaluation_config, slam_config

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Frame
from emgs_jax.evaluation.baselines import TsdfConfig, VoxelConfig
from emgs_jax.evaluation.reconstruction import compare_clouds, ground_truth_cloud, reference
from emgs_jax.evaluation.segmentation import align_labels
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.window_input import RawView
from emgs_jax.runs.dense import voxel_of
from emgs_jax.runs.gathering import Baselines, gather
from emgs_jax.runs.metrics import Scorer, score_baselines

INTRINSICS, SHAPE = (24.0, 24.0, 11.5, 7.5), (16, 24)
STATUSES = ("initialization", "tracked", "degraded", "lost", "tracked")
SCALES = (None, 2.0, 3.0, 3.0, 2.0)
WALL = 2.01  # the middle of a voxel
XS = 4.0 * np.arange(len(STATUSES))  # every camera sees a metre to each side, that no other sees
CONFIGS = {"voxel": VoxelConfig(0.02, 8, 0.1, 1), "tsdf": TsdfConfig(0.02, 0.08, 1)}


class Walls:
    """The frames, with the truth."""

    name, sequence, size, intrinsics, has_ground_truth = "walls", "one", SHAPE[::-1], INTRINSICS, True

    def __len__(self):
        return len(STATUSES)

    def __getitem__(self, row):
        image = np.full((*SHAPE, 3), 51, np.uint8)
        return Frame(row, 0.0, "f", image, np.full(SHAPE, WALL, np.float32), poses_along(XS)[row])


def gather_all(unit: float = 1.0):
    """The prior's depths are what the map's scales make of the truth, its poses two metres above ours.

    Lengths of the prior and of the map are in units of so many metres.
    """
    ours, raw = poses_along(XS), poses_along(XS)
    raw[:, 1, 3] += 2.0
    ours[:, :3, 3] /= unit
    raw[:, :3, 3] /= unit
    records = [
        FrameRecord(row, "f", 0.0, status, pose=ours[row], scale=scale)
        for row, (status, scale) in enumerate(zip(STATUSES, SCALES, strict=True))
    ]
    run = SimpleNamespace(records=records, poses=ours, raw_poses=raw, true_poses=list(ours))
    baselines = Baselines(CONFIGS, slam_config().observation, Walls())

    def frames():
        for row, record in enumerate(records):
            points = backproject(np.full(SHAPE, WALL / (SCALES[row] or 1.0) / unit), INTRINSICS)
            features = np.zeros((1, 2, 2), np.float16)  # left half, right half of the image
            features[0, :, row % 2] = 1.0 if row else [1.0, 0.0]
            mask = np.full(SHAPE, row != 4)
            mask[8, 12] = True  # alone it has no normal
            yield record, RawView(points, mask, Walls()[row].image, raw[row], features)

    text = ("wall", "cat"), np.eye(2, dtype=np.float32)
    return run, baselines, gather(frames(), evaluation_config(), True, baselines, text)


@pytest.fixture(scope="module")
def gathered():
    return gather_all()


@pytest.mark.parametrize("name", CONFIGS)
def test_in_another_unit_baselines_are_the_same_clouds_in_that_unit(gathered, name):
    """Voxels and truncation were lengths of the prior: with a unit of 4 m a voxel was 8 cm."""
    other = gather_all(unit=4.0)[1]  # a power of two, so that nothing is rounded
    for kind in ("raw", "ours"):
        expected, found = (getattr(baselines, kind)[name].cloud() for baselines in (gathered[1], other))
        np.testing.assert_allclose(4.0 * found.points, expected.points, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", CONFIGS)
def test_at_our_poses_is_what_the_map_took_where_and_as_large_as_the_map_took_it(gathered, name):
    """The last tracked frame has one point, without a normal; the degraded and the lost one are not fused."""
    cloud = gathered[1].ours[name].cloud()
    seen = [(np.abs(cloud.points[:, 0] - x) < 1.5).sum() for x in XS]
    assert [count > 100 for count in seen] == [True, True, False, False, False] and not any(seen[2:])
    np.testing.assert_allclose(cloud.points[:, 2], WALL, atol=1e-5)
    assert np.abs(cloud.points[:, 1]).max() < 1.0


@pytest.mark.parametrize("name", CONFIGS)
def test_at_the_priors_poses_is_all_that_the_prior_says_in_its_own_size(gathered, name):
    cloud = gathered[1].raw[name].cloud()
    for x, scale in zip(XS[:4], SCALES[:4], strict=True):
        rows = np.abs(cloud.points[:, 0] - x) < 1.5
        assert rows.sum() > 50
        np.testing.assert_allclose(cloud.points[rows, 2], WALL / (scale or 1.0), atol=1e-5)
    assert np.abs(cloud.points[:, 1] - 2.0).max() < 1.0
    if name == "voxel":
        assert (cloud.points[:, 0] > XS[3] + 1.5).sum() == 1


def test_the_raw_priors_points_are_zero_where_it_says_nothing_and_are_kept_where_they_are_of_use(gathered):
    points = gathered[2].points
    assert len(points) == len(STATUSES) and (points[4][..., 2] > 0).sum() == 1 and (points[4] != 0).any(-1).sum() == 1
    np.testing.assert_allclose(points[1][..., 2], WALL / 2.0, rtol=1e-6)
    assert len(gather([], evaluation_config(), False).points) == 0


def test_without_truth_and_baselines_no_cloud_is_made(monkeypatch):
    """Symptom: an hour of a camera wrote 60 GB to the disk that nobody read, at a quarter of a step's time."""
    monkeypatch.setattr("emgs_jax.runs.gathering.camera_cloud", None)
    view = RawView(np.ones((*SHAPE, 3)), np.ones(SHAPE, bool), Walls()[0].image, np.eye(4), np.zeros((1, 2, 2)))
    record = FrameRecord(0, "f", 0.0, "tracked", pose=np.eye(4))
    for baselines in (None, Baselines({}, slam_config().observation, Walls())):
        found = gather([(record, view)], evaluation_config(), False, baselines, has_truth=False)
        assert len(found.points) == 0


def test_the_classes_of_each_frame_are_kept_and_those_of_its_points_are_where_the_prior_puts_them(gathered):
    _, _, raw = gathered
    found = raw.labels.points(evaluation_config().voxel_m)
    width = SHAPE[1] // 2
    assert len(raw.classes) == len(STATUSES)
    np.testing.assert_array_equal(raw.classes[0], np.tile(np.repeat([0, -1], [width, SHAPE[1] - width]), (SHAPE[0], 1)))
    np.testing.assert_array_equal(raw.classes[1], np.ones(SHAPE))
    assert found.classes == ("wall", "cat") and (found.points[:, 1] > 1.0).all()
    for row in (1, 2, 3):
        seen = np.abs(found.points[:, 0] - XS[row]) < 1.0
        assert seen.sum() > 50 and (found.labels[seen] == row % 2).all()
    plain = gather([], evaluation_config(), False)
    assert plain.classes is None and plain.labels is None


def test_baselines_are_compared_at_the_poses_that_they_were_built_at(gathered):
    """Ours has a view of five exact, and one more of the degraded frame if it were there; the prior's is too small."""
    run, baselines, raw = gathered
    config = evaluation_config("evaluation.alignment=se3")
    truth = reference(ground_truth_cloud([Walls()[row] for row in (0, 1)], INTRINSICS, config), config)
    metrics = score_baselines(run, baselines, raw, Scorer(Walls(), config, truth, None, None, True))
    for name in CONFIGS:
        assert metrics[f"baseline_{name}_ours/reconstruction/accuracy_m"] < 0.05
        assert metrics[f"baseline_{name}_ours/reconstruction_icp/f1_20cm_percent"] > 95.0
        assert metrics[f"baseline_{name}_raw/reconstruction/accuracy_m"] > 0.5
        # A TSDF ends before the border of its views, here one of 8 rows.
        assert metrics[f"baseline_{name}_ours/rendering/coverage_percent"] == pytest.approx(40.0, abs=6.0)
        assert metrics[f"baseline_{name}_ours/rendering/depth_l1_m"] < 1e-3
        assert metrics[f"baseline_{name}_raw/rendering/coverage_percent"] == pytest.approx(80.0, abs=20.0)
        # Of the frames that the prior sees one has the true size.
        assert metrics[f"baseline_{name}_raw/rendering/depth_within_5_percent"] == pytest.approx(20.0, abs=4.0)
        assert metrics[f"baseline_{name}_ours/rendering/psnr_db"] > 40.0
    run.true_poses = [None] * len(STATUSES)
    assert score_baselines(run, baselines, raw, Scorer(Walls(), config, truth, None, None, True)) == {}


@pytest.mark.parametrize("metres_per_unit", [0.001, 3.0, 30.0, 1000.0])
def test_a_prior_scores_the_same_in_whatever_unit_it_answers(metres_per_unit):
    """Points were averaged per centimetre of its own lengths: exact answers in units of 30 m had F1 27 %."""
    evaluation, walls, text = evaluation_config(), Walls(), (("wall",), np.ones((1, 1), np.float32))
    frames = [walls[row] for row in range(len(walls))]
    truth = reference(ground_truth_cloud(frames, INTRINSICS, evaluation), evaluation)

    def scored(unit):
        views, poses = [], []
        for frame in frames:
            pose = frame.T_world_camera.copy()
            pose[:3, 3] /= unit
            points = (backproject(frame.depth, INTRINSICS) / unit).astype(np.float32)
            view = RawView(points, frame.depth > 0, frame.image, pose, np.ones((1, 1, 1), np.float16))
            views.append((None, view))
            poses.append(pose)
        both, raw = (np.stack(poses), poses_along(XS)), gather(views, evaluation, False, text=text)
        labels = align_labels(raw.labels, truth, both, evaluation)
        return compare_clouds(raw.cloud, truth, both, evaluation), len(labels.points), labels.points.max(0)

    (metric, count, corner), (other, other_count, other_corner) = scored(1.0), scored(metres_per_unit)
    assert metric["reconstruction/f1_5cm_percent"] > 99.9
    for key, value in metric.items():
        # Points at the border of a voxel fall to either side; a centimetre is what a voxel has.
        assert other[key] == value if isinstance(value, str | None) else other[key] == pytest.approx(value, 0.02, 5e-4)
    assert other_count == pytest.approx(count, rel=0.02)
    np.testing.assert_allclose(other_corner, corner, atol=evaluation.voxel_m)


def test_the_map_is_averaged_by_a_centimetre_of_the_truth_and_never_by_more_than_one_of_its_own():
    config, true = evaluation_config(), poses_along(XS)
    for unit, side in ((1.0, 1.0), (40.0, 1 / 40), (0.001, 1.0)):
        own = true.copy()
        own[:, :3, 3] /= unit
        assert voxel_of((own, true), config) == pytest.approx(side * config.voxel_m)
    assert voxel_of(None, config) == config.voxel_m


def test_what_goes_wrong_in_gathering_ends_the_mapping_one_frame_later():
    asked = []

    def views():
        for number in range(9):
            asked.append(number)
            image, features = np.zeros((2, 2, 3)), np.zeros((1, 1, 0))
            yield None, RawView(np.zeros((2, 2)), np.ones((2, 2), bool), image, np.eye(4), features)

    with pytest.raises(IndexError):
        gather(views(), evaluation_config(), True)
    assert asked == [0, 1]
