"""KITTI odometry's folders; oracle: centres of the cameras that the projections were written for."""

import numpy as np
import pytest
from written_scene import scene_pose

from emgs_jax.data.kitti import Kitti
from tests.data.written_benchmarks import CENTER
from tests.data.written_benchmarks import KITTI_SIZE as SIZE


def load(root, sequence="07", **options):
    return Kitti(str(root), sequence, **{"size": SIZE, **options})


def test_poses_are_those_of_the_camera_that_took_the_images(kitti_root):
    dataset = load(kitti_root)
    assert not dataset.has_ground_truth and dataset.intrinsics == (92, 92, 78, 23)
    for row in range(3):
        frame = dataset[row]
        truth = scene_pose(row)
        np.testing.assert_allclose(frame.T_world_camera[:3, 3], truth[:3, :3] @ CENTER + truth[:3, 3], atol=1e-9)
        np.testing.assert_allclose(frame.T_world_camera[:3, :3], truth[:3, :3], atol=1e-9)
    np.testing.assert_allclose([frame.timestamp for frame in dataset], [0, 0.1037, 0.2074])
    for same in (7, "7"):  # YAML and the command line may take 07 for a number
        assert load(kitti_root, same).fingerprint() == dataset.fingerprint() and load(kitti_root, same).sequence == "07"


def test_poses_may_stand_beside_the_images_or_be_missing(kitti_root):
    poses, beside = kitti_root / "poses" / "07.txt", kitti_root / "sequences" / "07" / "poses.txt"
    truth = load(kitti_root).pose(1)
    poses.rename(beside)
    np.testing.assert_array_equal(load(kitti_root).pose(1), truth)
    beside.unlink()
    assert load(kitti_root).pose(1) is None


def test_a_download_of_grey_images_needs_no_setting(kitti_root):
    folder, in_colour = kitti_root / "sequences" / "07", load(kitti_root)
    (folder / "image_2").rename(folder / "image_0")
    grey = load(kitti_root)
    assert grey.fingerprint() == load(kitti_root, camera=0).fingerprint() != in_colour.fingerprint()
    assert not np.allclose(grey.pose(1), in_colour.pose(1)), "the left grey camera is the one that has the poses"
    with pytest.raises(FileNotFoundError, match=r"image_2 is no folder"):
        load(kitti_root, camera=2)


def test_only_positions_of_images_in_use_have_to_be_near(kitti_root):
    """Sequence 01 goes 1.8 km; its first part does not."""
    rows = np.array([scene_pose(i)[:3].ravel() for i in range(3)])
    rows[2, 3] = 1800.0
    np.savetxt(kitti_root / "poses" / "07.txt", rows)
    assert len(load(kitti_root, stop=2)) == 2
    with pytest.raises(ValueError, match=r"07.txt, image 000002.png, has a position of \[1800"):
        load(kitti_root)
