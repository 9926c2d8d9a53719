"""What may be wrong with files is named, by the file and the key."""

import numpy as np
import pytest
from written_predictions import KEYS, NAMES, Named, asked, write_depths, write_npz

from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.prior.files.prior import Files

SIZE = (48, 64)


@pytest.fixture
def own(tmp_path):
    return write_npz(tmp_path / "own", NAMES)


def matrix(frame, **scaled):
    pose = frame.T_world_camera.copy()
    pose[:3, 3] *= scaled.get("unit", 1)
    pose[:3, :3] *= scaled.get("turn", 1)
    return pose


FAULTS = {
    "no poses": ({"T_world_camera": None}, r"IMG_8.npz lacks T_world_camera; it has depth.*multiview_stereo"),
    "neither": ({"depth": None}, r"IMG_8.npz must have depth or points, one of them; it has T_world_camera"),
    "a row": ({"depth": lambda f: f.depth.ravel()}, r"IMG_8.npz: depth must be \(h, w\), got \(3072,\)"),
    "cropped": ({"depth": lambda f: f.depth[:, :30]}, r"IMG_8.npz: depth is 30x48 .* must show the whole image"),
    "mm": ({"depth": lambda f: f.depth * 1000}, r"IMG_8.npz: depth has a median of \d+, which is no depth in metres"),
    "no rotation": ({"T_world_camera": lambda f: matrix(f, turn=2)}, r"IMG_8.npz: T_world_camera is no rigid motion"),
    "poses in mm": (
        {"T_world_camera": lambda f: matrix(f, unit=1000)},
        r"T_world_camera of .*own/\*\.npz: the depths of two views .* by about 1000, or the positions by 0.001",
    ),
    "inverse": (
        {"T_world_camera": lambda f: np.linalg.inv(f.T_world_camera)},
        "are taken as world -> camera: expected are poses camera -> world",
    ),
    "OpenGL": (
        {"T_world_camera": lambda f: f.T_world_camera * [1, -1, -1, 1]},
        "are taken as camera -> world of OpenGL's axes",
    ),
    "probabilities": (
        {"confidence": lambda f: np.full(SIZE, 0.3)},
        r"IMG_8.npz: depth: confidence must be at least 1 .* is 0.3: .* give 1 \+ confidence",
    ),
    "confidence of another size": (
        {"confidence": lambda f: np.ones((4, 5))},
        r"confidence must be numbers \(48, 64\)",
    ),
    "intrinsics of the image": ({"intrinsics": lambda f: [999, 999, 320, 240]}, r"own size \(64x48\)"),
    "nothing to see": ({"depth": lambda f: f.depth * np.nan}, "none of its 6 files has a depth above 0"),
    "never known": ({"T_world_camera": lambda f: np.full((4, 4), np.nan)}, "none of 6 is known"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_is_named_with_file_and_key(fault, tmp_path):
    changes, message = FAULTS[fault]
    with pytest.raises(ValueError, match=message):
        asked(write_npz(tmp_path / "own", NAMES, **changes))


def test_a_file_that_is_missing_too_many_or_no_file_at_all_is_named(own, tmp_path):
    with pytest.raises(ValueError, match=r"does not exist: give the folder"):
        asked(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"has no file \*.npz, \*.exr"):
        asked(tmp_path)
    with pytest.raises(ValueError, match=r"has 6 predictions \(IMG_8 ...\) and the data set 5 frames \(a ...\)"):
        asked(own, Named(names=["a", "b", "c", "d", "e"]))
    (own / "IMG_9.npz").unlink()
    with pytest.raises(ValueError, match=r"has no file for 1 of 6 frames, the first is IMG_9"):
        asked(own)
    (own / "IMG_9.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"IMG_9.npz: .*; it has nothing"):
        asked(own)


def test_a_list_of_poses_of_another_length_or_without_a_name_is_named(tmp_path):
    folder = tmp_path / "images"
    write_depths(folder, ".npy")
    with pytest.raises(
        ValueError, match=r"has 6 files \*.npy and neither of poses.txt, poses.json: .*multiview_stereo"
    ):
        asked(folder)
    save_trajectory_tum(folder / "poses.txt", range(5), [np.eye(4)] * 5)
    with pytest.raises(ValueError, match=r"poses.txt has 5 poses for 6 files"):
        asked(folder)
    (folder / "poses.txt").unlink()
    (folder / "poses.json").write_text('{"T_world_camera": {"IMG_8": null}}')
    with pytest.raises(ValueError, match=r"poses.json lacks T_world_camera of 5 of 6 files, first IMG_9"):
        asked(folder)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"scale": "relative"}, "prior.scale must be one of auto, metric, arbitrary"),
        ({"median_depth": 0.0}, "prior.median_depth must be above 0 m"),
        ({"depth_scale": 0.0}, "prior.depth_scale must be raw units per metre"),
    ],
)
def test_a_key_without_sense_is_named(keys, message, own):
    with pytest.raises(ValueError, match=message):
        Files(own, **(KEYS | keys))
