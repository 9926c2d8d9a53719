"""Replica in the NICE-SLAM layout."""

import numpy as np
import pytest
from written_scene import plane_depth, scene_pose

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.class_file import read_classes
from emgs_jax.data.replica import Replica


def load(root, **options):
    return Replica(str(root), "office9", **{"stride": 1, "size": (60, 34), **options})


def test_frames_have_the_scenes_depth_and_poses(replica_root):
    dataset = load(replica_root)
    np.testing.assert_allclose(dataset.intrinsics, (30, 30, 29.5, 16.5))
    for i, frame in enumerate(dataset):
        assert frame.timestamp == i
        np.testing.assert_allclose(frame.T_world_camera, scene_pose(i), atol=1e-8)
        truth = plane_depth(scene_pose(i), dataset.intrinsics, (60, 34))
        assert np.abs(frame.depth - truth).max() < 0.05  # half of a coarse raw pixel, 1/120 wide, on a slant of 3 m
        assert abs(frame.image[..., 0].mean() - (40 * i + 20)) < 2


def test_a_frame_belongs_to_the_row_of_its_number_and_fewer_rows_than_images_are_an_error(replica_root):
    path = replica_root / "office9" / "traj.txt"
    for image in list((replica_root / "office9" / "results").glob("*000001*")):
        image.unlink()
    dataset = load(replica_root)
    assert [frame.timestamp for frame in dataset] == [0, 2]
    np.testing.assert_allclose(dataset[1].T_world_camera, scene_pose(2), atol=1e-8)
    path.write_text("\n".join(path.read_text().splitlines()[:2]))
    with pytest.raises(ValueError, match="traj.txt has 2 poses, but there is an image number 2"):
        load(replica_root)
    assert len(load(replica_root, stop=1)) == 1


def test_a_row_that_is_no_pose_or_blank_is_a_bad_frame_and_moves_no_other(replica_root):
    path = replica_root / "office9" / "traj.txt"
    rows = path.read_text().splitlines()
    for second in (rows[1][:40], rows[1].replace("e", "x", 1), ""):
        path.write_text("\n".join(["# a comment moved all poses by one", rows[0], second, rows[2], "", ""]))
        dataset = load(replica_root)
        np.testing.assert_allclose(dataset[2].T_world_camera, scene_pose(2), atol=1e-8)
        with pytest.raises(BadFrameError, match="traj.txt, row 1"):
            dataset[1]


def test_a_calibration_of_other_images_names_the_file(replica_root):
    path = replica_root / "cam_params.json"
    whole = path.read_text()
    for before, after, message in (
        ("120", "1", " .* principal point outside of the 1x68 images"),
        ("6553.5", "-1", ": scale must be raw units per metre.* got -1"),
        ('"w": 120', '"w": 1200', " .* odd for the 1200x68 images: the view is 169 degrees wide"),
    ):
        path.write_text(whole.replace(before, after))
        with pytest.raises(ValueError, match=f"cam_params.json{message}"):
            load(replica_root)
    path.write_text(whole.replace('"w": 120', '"w": 160'))
    assert "principal point is 12 % of the width from the middle" in load(replica_root).calibration["note"]
    with pytest.raises(BadFrameError, match="frame000000.jpg is 120x68, but .* are 160x68"):
        load(replica_root)[0]


def test_points_of_one_real_frame_lie_on_the_surfaces_of_another_and_ovos_classes_are_51(shared_data, depth_gaps):
    dataset = Replica(shared_data("replica"), "office0_from_mesh", stride=1)
    assert len(dataset) == 200
    for pair in ((0, 1), (60, 62), (150, 145)):
        assert np.median(np.abs(depth_gaps(dataset, *pair))) < 0.006  # exact depth; half a pixel of rounding on slants
    found = read_classes(f"{shared_data('replica')}/ovo_eval_info.yaml")
    assert len(found.names) == 51 and found.names[:3] == ("wall", "ceiling", "floor")
    np.testing.assert_array_equal(found.positions_of(np.array([93, 79, -2, 101]), "x"), [0, 50, -1, -1])
