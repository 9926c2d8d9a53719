"""EuRoC's folders; oracles: poses from which the files were written, the lens of dataset=images."""

import numpy as np
from written_scene import scene_pose

from emgs_jax.data.euroc import Euroc
from emgs_jax.data.images import Images
from tests.data.written_benchmarks import LENS, START


def load(root, **options):
    return Euroc(str(root), "MH_01_easy", **{"stride": 1, "size": (160, 120), **options})


def test_poses_are_the_cameras_and_not_the_bodys_and_times_are_seconds(euroc_root):
    dataset = load(euroc_root)
    assert dataset.pose(0) is None and not dataset.has_ground_truth
    for row in (1, 2):
        np.testing.assert_allclose(dataset[row].T_world_camera, scene_pose(row), atol=1e-7)
    np.testing.assert_allclose([dataset[row].timestamp - START / 1e9 for row in range(3)], [0, 0.05, 0.1], atol=5e-7)


def test_images_are_straightened_as_those_of_a_folder_with_these_numbers(euroc_root):
    folder = euroc_root / "MH_01_easy" / "mav0" / "cam0" / "data"
    same, dataset = Images(str(folder), size=(160, 120), intrinsics=LENS), load(euroc_root)
    assert dataset.intrinsics == same.intrinsics
    np.testing.assert_array_equal(dataset[1].image, same[1].image)


def test_a_lens_with_equidistant_distortion_is_a_fisheye(euroc_root):
    path = euroc_root / "MH_01_easy" / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(path.read_text().replace("radial-tangential", "equidistant"))
    same = Images(str(path.parent / "data"), size=(160, 120), intrinsics=["OPENCV_FISHEYE", *LENS])
    np.testing.assert_array_equal(load(euroc_root)[1].image, same[1].image)
    assert (
        load(euroc_root).intrinsics == same.intrinsics != Images(str(path.parent / "data"), intrinsics=LENS).intrinsics
    )


def test_without_the_truths_folder_there_are_no_poses(euroc_root):
    truth = euroc_root / "MH_01_easy" / "mav0" / "state_groundtruth_estimate0"
    whole = load(euroc_root).fingerprint()
    (truth / "data.csv").unlink()
    assert load(euroc_root).pose(1) is None and load(euroc_root).fingerprint() != whole
