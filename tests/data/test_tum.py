"""TUM layout: association by time, calibration, undistortion."""

from pathlib import Path

import numpy as np
import pytest
from written_scene import plane_depth, scene_pose

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.timestamps import nearest_rows
from emgs_jax.data.tum import Tum, read_list

SEQUENCE = "rgbd_dataset_freiburg3_plane"
LISTS = ("rgb", "depth", "groundtruth")


def load(root, sequence=SEQUENCE, **options):
    return Tum(str(root), sequence, **{"stride": 1, **options})


def test_frames_have_the_scenes_depth_and_poses_whatever_the_order_of_the_lines(tum_root):
    for edit in (
        lambda text: text,
        lambda text: "\n\n# again\n".join(reversed(text.splitlines())),
        lambda text: "\ufeff" + text,  # a mark before the first letter is no letter
    ):
        for name in LISTS:
            path = tum_root / SEQUENCE / f"{name}.txt"
            path.write_text(edit(path.read_text()), encoding="utf-8")
        dataset = load(tum_root)
        assert dataset.has_ground_truth
        np.testing.assert_allclose(dataset.intrinsics, (267.7, 269.6, 159.8, 123.55))
        for i, frame in enumerate(dataset):
            assert frame.timestamp == 100.0 + i
            np.testing.assert_allclose(frame.T_world_camera, scene_pose(i), atol=1e-6)
            truth = plane_depth(scene_pose(i), dataset.intrinsics, (320, 240))
            assert np.abs(frame.depth - truth).max() < 0.005  # nearest: half a pixel of a slanted plane
            assert abs(frame.image[..., 0].mean() - (40 * i + 20)) < 1


def test_the_nearest_row_in_time_is_taken_within_the_tolerance():
    rng = np.random.default_rng(0)
    times, candidates = rng.uniform(0, 10, 50), np.sort(rng.uniform(0, 10, 70))
    gaps = np.abs(times[:, None] - candidates)
    truth = np.where(gaps.min(1) <= 0.03, gaps.argmin(1), -1)
    assert nearest_rows(times, candidates, 0.03) == truth.tolist()
    assert nearest_rows(times, candidates[:0], 0.03) == [-1] * 50
    assert nearest_rows(np.array([1.0, 5.0]), np.array([1.01]), 0.02) == [0, -1]


def test_an_image_without_depth_or_pose_near_in_time_stays_in_use(tum_root):
    paths = [tum_root / SEQUENCE / f"{name}.txt" for name in LISTS[1:]]
    for path in paths:
        lines = path.read_text().splitlines()
        path.write_text("\n".join([lines[0], lines[1], lines[3]]))  # the second frame's row is gone
    frames = list(load(tum_root))
    assert [frame.T_world_camera is None for frame in frames] == [False, True, False]
    assert [bool((frame.depth > 0).any()) for frame in frames] == [True, False, True]
    for path in paths:
        path.unlink()
    dataset = load(tum_root)
    assert not dataset.has_ground_truth and dataset[0].depth is None and dataset[0].T_world_camera is None


def test_an_unknown_folder_takes_intrinsics(tum_root):
    (tum_root / SEQUENCE).rename(tum_root / "my_desk")
    of_1000, of_5000 = (
        load(tum_root, "my_desk", intrinsics=[500, 500, 320, 240], depth_scale=scale) for scale in (1000, 5000)
    )
    np.testing.assert_allclose(of_1000.intrinsics, (250, 250, 159.75, 119.75))
    np.testing.assert_allclose(of_1000[0].depth, 5 * of_5000[0].depth, rtol=1e-5)


def test_freiburg1_images_are_undistorted_and_freiburg3_images_are_not(tum_root):
    straight = load(tum_root)[0].image
    (tum_root / SEQUENCE).rename(tum_root / "rgbd_dataset_freiburg1_plane")
    bent = load(tum_root, "rgbd_dataset_freiburg1_plane")
    assert np.abs(bent[0].image.astype(int) - straight).max() > 3
    fx, _, cx, cy = bent.intrinsics
    assert 258 < fx < 300  # cropped to what the distorted image covers, so longer than the 258.7 of the lens
    np.testing.assert_allclose((cx, cy), (159.5, 119.5), atol=1e-6)  # the new centre is the image's


def test_a_pose_that_is_not_finite_is_lost_and_one_that_is_no_rotation_is_a_bad_frame(tum_root):
    path = tum_root / SEQUENCE / "groundtruth.txt"
    path.write_text("# time\n101.995 0 0 0 0 0 0 1\n99.995 0 0 0 0 0 0 0\n100.995 nan 0 0 0 0 0 1\n")
    dataset = load(tum_root)
    with pytest.raises(BadFrameError, match="groundtruth.txt, line 3: .* has not length 1: correct the line or take"):
        dataset[0]
    assert dataset[1].T_world_camera is None
    np.testing.assert_array_equal(dataset[2].T_world_camera, np.eye(4))


def test_points_of_one_real_frame_lie_on_the_surfaces_of_the_next(shared_data, depth_gaps):
    dataset = Tum(shared_data("tum"), "rgbd_dataset_freiburg3_cabinet", stride=1)
    assert len(dataset) == 48
    assert np.median(np.abs(np.concatenate([depth_gaps(dataset, i, i + 1) for i in (3, 20, 40)]))) < 0.025


@pytest.mark.parametrize(
    "line",
    [
        "{time} rgb\\\\{name}",
        "{time} rgb/my {name}",
        "{time},rgb/my {name}",
        '{time} "rgb/my {name}"',
        "{time} rgb/{name} {time} depth/{name}",
    ],
)
def test_lists_may_have_backslashes_spaces_quotes_and_more_columns(line, tum_root):
    (folder,) = tum_root.iterdir()
    times, names, _ = read_list(folder / "rgb.txt", 2)
    if "my" in line:
        for (name,) in names:
            (folder / name).rename(folder / "rgb" / f"my {Path(name).name}")
    lines = [line.format(time=time, name=Path(name).name) for time, (name,) in zip(times, names, strict=True)]
    (folder / "rgb.txt").write_text("\n".join(lines))
    dataset = Tum(str(tum_root), folder.name, stride=1)
    assert [frame.timestamp for frame in dataset] == [100.0, 101.0, 102.0]
    assert all(frame.image.mean() > 0 and (frame.depth > 0).any() for frame in dataset)


def test_a_clock_that_was_set_back_is_told_with_its_line(tum_root):
    (folder,) = tum_root.iterdir()
    lines = (folder / "rgb.txt").read_text().splitlines()
    assert "note" not in Tum(str(tum_root), folder.name, stride=1).calibration
    (folder / "rgb.txt").write_text("\n".join([*lines[:-2], lines[-1], lines[-2]]))
    said = Tum(str(tum_root), folder.name, stride=1).calibration["note"]
    assert f"rgb.txt, line {len(lines)}: time goes back by 1.000 s" in said
