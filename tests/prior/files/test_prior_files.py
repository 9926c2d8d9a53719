"""`prior=files`: against the exact prior, the truth that was written, and analytic planes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny_run
from written_predictions import KEYS, NAMES, Named, asked, by_frame, truth, write_depths, write_npz

from emgs_jax.data.backprojection import backproject
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.prior.base import Prior, relative_poses
from emgs_jax.prior.files.naming import rows_of
from emgs_jax.prior.files.prior import Files, read_predictions
from emgs_jax.prior.files.view import Camera, View, at_frame, whole_image

pytestmark = pytest.mark.xdist_group("tiny")

SIZE = (48, 64)
UNKNOWN = "how sure the poses are is not known (prior.pose_std)"


@pytest.fixture
def own(tmp_path):
    return write_npz(tmp_path / "own", NAMES)


class Describing(Prior):
    """Files with the features and the confidence of the exact prior, so that a run has the shapes of the exact one."""

    def __init__(self, files: Files) -> None:
        self._files, self._exact = files, tiny_run.EditedPrior()
        self.provenance, self.feature_names = self._exact.provenance, self._exact.feature_names
        self.text_features = self._exact.text_features

    def predict(self, window, frames, intrinsics):
        exact = self._exact.predict(window, frames, intrinsics)
        found = self._files.predict(window, frames, intrinsics)
        return replace(found, features=exact.features, confidence=exact.confidence)


def test_true_depths_and_poses_make_the_map_of_an_exact_prior_bit_for_bit(own):
    prior, _ = asked(own)
    run, maps = tiny_run.map_tiny(tiny_run.dataset(), Describing(prior))
    exact, exact_maps = tiny_run.exact()
    for found, expected in zip(jax.tree.leaves(maps[-1]), jax.tree.leaves(exact_maps[-1]), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert [record.status for record in run.records] == [record.status for record in exact.records]


def test_every_window_says_the_same_of_a_frame_and_poses_are_relative_to_the_anchor(own):
    _, predictions = asked(own)
    poses = np.stack([frame.T_world_camera for frame in truth()])
    expected = backproject(np.stack([frame.depth for frame in truth()]), tiny_run.dataset().intrinsics)
    for prediction in predictions:
        views = list(prediction.window.views)
        np.testing.assert_allclose(prediction.T_anchor_view, relative_poses(poses[views]), atol=1e-12)
        np.testing.assert_array_equal(prediction.points, expected[list(prediction.window.dense)].astype(np.float32))
        assert prediction.features.shape == (len(prediction.window.dense), *SIZE, 0)
        assert prediction.confidence.dtype == np.float32 and np.all(prediction.confidence == 1)


def write_poses(folder: Path, suffix: str, **more) -> None:
    poses = [frame.T_world_camera for frame in truth()]
    if suffix == ".txt":
        save_trajectory_tum(folder / "poses.txt", range(len(poses)), poses)
    else:
        named = {name: pose.tolist() for name, pose in zip(NAMES, poses, strict=True)}
        (folder / "poses.json").write_text(json.dumps({"T_world_camera": named} | more))


@pytest.mark.parametrize(
    ("suffix", "poses", "tolerance"),
    [(".png", ".txt", 0.9e-3), (".exr", ".json", 1e-6), (".npy", ".json", 1e-6)],  # half a millimetre along the ray
)
def test_depth_images_with_a_list_of_poses_say_the_same_as_npz(suffix, poses, tolerance, own, tmp_path):
    folder = tmp_path / "images"
    write_depths(folder, suffix)
    write_poses(folder, poses)
    _, expected = asked(own)
    _, found = asked(folder)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=tolerance)
        np.testing.assert_allclose(one.T_anchor_view, other.T_anchor_view, atol=1e-8)  # of nine digits
        np.testing.assert_array_equal(one.mask, other.mask)


def test_points_say_what_depths_do(own, tmp_path):
    intrinsics = tiny_run.dataset().intrinsics
    points = write_npz(tmp_path / "points", NAMES, depth=None, points=lambda f: backproject(f.depth, intrinsics))
    for one, other in zip(asked(points)[1], asked(own)[1], strict=True):
        np.testing.assert_array_equal(one.points, other.points)


def plane(camera: Camera) -> np.ndarray:
    """Depths of z (n · ray) = 2 at every pixel."""
    rays = backproject(np.ones(camera.size[::-1]), camera.intrinsics)
    return 2 / (rays @ [0.2, -0.1, 1.0])


@pytest.mark.parametrize("grid", [(128, 96), (32, 24), (70, 50), (64, 48)])
@pytest.mark.parametrize("longer", [None, 1.04])
def test_a_file_of_any_size_shows_the_same_plane_on_its_own_rays(grid, longer):
    """Between pixels as well; `longer`: the file's focal length in that of the data set, None: it has none."""
    camera = Camera((64, 48), (60.0, 61.0, 31.0, 24.5))
    x, y = grid[0] / 64, grid[1] / 48
    same = (60.0 * x, 61.0 * y, 31.5 * x - 0.5, 25.0 * y - 0.5)
    intrinsics = same if longer is None else (same[0] * longer, same[1] * longer, *same[2:])
    depth = plane(Camera(grid, intrinsics))
    view = View("file", depth, None, None if longer is None else intrinsics)
    points, _, mask = at_frame(view, camera, whole_image, 0.1)
    inner = np.s_[2:-2, 2:-2]  # at the edge of a coarser grid the nearest pixel stands for what lies beyond
    assert mask.all()
    np.testing.assert_allclose(points[inner] @ [0.2, -0.1, 1.0], 2, atol=1e-5)
    rays = backproject(np.ones((48, 64)), camera.intrinsics)
    scale = np.array([longer or 1.0] * 2 + [1.0])
    np.testing.assert_allclose((points / points[..., 2:])[inner] * scale, rays[inner], atol=1e-5)


def test_where_a_file_has_no_value_there_is_no_point(tmp_path):
    def holed(frame):
        depth = frame.depth.copy()
        depth[:2], depth[2:4], depth[4:6] = 0, np.nan, np.inf
        return depth

    _, predictions = asked(write_npz(tmp_path / "holed", NAMES, depth=holed, confidence=lambda f: f.depth + 1))
    for index, (points, mask, confidence) in by_frame(predictions).items():
        assert not mask[:6].any() and mask[6:].all()
        assert not points[:6].any() and np.all(confidence[:6] == 1)
        np.testing.assert_allclose(confidence[6:], truth()[index].depth[6:] + 1, rtol=1e-6)


def test_what_is_right_up_to_a_factor_gets_the_median_depth_that_is_asked_for(own, tmp_path):
    def far(frame):
        pose = frame.T_world_camera.copy()
        pose[:3, 3] *= 700
        return pose

    folder = write_npz(tmp_path / "far", NAMES, depth=lambda f: f.depth * 700, T_world_camera=far)
    median = float(np.median(truth()[0].depth))
    prior, found = asked(folder, scale="arbitrary", median_depth=1.5)
    for one, other in zip(found, asked(own)[1], strict=True):
        np.testing.assert_allclose(one.points, other.points * 1.5 / median, rtol=1e-5, atol=1e-6)
        expected = other.T_anchor_view.copy()
        expected[:, :3, 3] *= 1.5 / median
        np.testing.assert_allclose(one.T_anchor_view, expected, atol=1e-6)
    assert prior.provenance.settings["scale"] == "arbitrary" and prior.provenance.settings["median_depth"] == 1.5


@pytest.mark.parametrize("lost", [0, 2])
def test_a_frame_whose_pose_is_not_known_has_no_points_and_the_others_stay_in_one_frame(lost, tmp_path):
    unknown = lambda f: np.full((4, 4), np.nan) if f.index == lost else f.T_world_camera  # noqa: E731
    _, predictions = asked(write_npz(tmp_path / "lost", NAMES, T_world_camera=unknown))
    first = np.eye(4) if lost == 0 else np.linalg.inv(truth()[0].T_world_camera)
    for prediction in predictions:
        for row, index in enumerate(prediction.window.views):
            expected = np.full((4, 4), np.nan) if index == lost else first @ truth()[index].T_world_camera
            np.testing.assert_allclose(prediction.T_anchor_view[row], expected, atol=1e-12)
        for row, index in enumerate(prediction.window.dense):
            assert prediction.mask[row].any() == (index != lost)


def test_files_are_found_by_the_name_of_the_image_and_else_by_their_order(own, tmp_path):
    """IMG_13 comes after IMG_8, and a video has no names."""
    expected = by_frame(asked(own)[1])
    turned = Named(names=NAMES[::-1])
    for index, (points, *_) in by_frame(asked(own, turned)[1]).items():
        np.testing.assert_array_equal(points, expected[len(NAMES) - 1 - index][0])
    video = Named(names=["walk"] * len(NAMES), suffix=".mp4")
    for index, (points, *_) in by_frame(asked(own, video)[1]).items():
        np.testing.assert_array_equal(points, expected[index][0])


def test_listed_poses_are_of_the_files_whose_numbers_are_their_times(own, tmp_path):
    """A script lists IMG_10 before IMG_8, and files are read by their numbers: each had another one's pose."""
    write_depths(tmp_path / "images", ".npy")
    rows = sorted(range(len(NAMES)), key=lambda row: NAMES[row])
    poses = [truth()[row].T_world_camera for row in rows]
    save_trajectory_tum(tmp_path / "images" / "poses.txt", [int(NAMES[row][4:]) for row in rows], poses)
    for one, other in zip(asked(tmp_path / "images")[1], asked(own)[1], strict=True):
        np.testing.assert_allclose(one.T_anchor_view, other.T_anchor_view, atol=1e-8)
    path = tmp_path / "images" / "poses.txt"
    path.write_text(re.sub(r"\n8\.0+ .*\n", "\n8 nan nan nan nan nan nan nan\n", path.read_text()))
    lost = np.isnan(read_predictions(path.parent, 1000.0).poses).all((1, 2))
    np.testing.assert_array_equal(lost, [name == "IMG_8" for name in NAMES])


def test_of_two_predictions_with_the_name_of_one_image_none_is_chosen(own):
    """COLMAP's a/1.jpg and b/1.jpg: the images of the one were mapped with depths of the other."""
    with pytest.raises(ValueError, match="several predictions of the name IMG_9, of which one is of the frame"):
        rows_of(Named(), [*NAMES[:2], NAMES[1], *NAMES[3:]], own)


def test_the_provenance_tells_files_apart_by_what_they_hold(own, tmp_path):
    other = write_npz(tmp_path / "other", NAMES, depth=lambda f: f.depth + 1e-3)
    same = write_npz(tmp_path / "same", NAMES)
    settings = [Files(folder, **KEYS).provenance.settings for folder in (own, other, same)]
    assert settings[0] == settings[2] != settings[1] and settings[0]["scale"] == "metric"


def test_what_was_found_is_one_line_and_says_by_how_much_focal_lengths_differ(tmp_path, capsys):
    fx, fy, cx, cy = tiny_run.dataset().intrinsics
    near = write_npz(tmp_path / "near", NAMES, intrinsics=lambda f: [fx * 1.02, fy * 1.02, cx, cy])
    asked(near)
    fit = "the depths of two views differ by 0.3 %"
    assert capsys.readouterr().out.splitlines() == [f"prior=files: {near}, layout npz, metres; {fit}, {UNKNOWN}"]
    asked(write_npz(tmp_path / "more", NAMES, mask=lambda f: f.depth > 2))  # depths that it marks were taken in silence
    assert f"{UNKNOWN}; not read: mask" in capsys.readouterr().out
    far = write_npz(tmp_path / "far", NAMES, intrinsics=lambda f: [[fx * 1.1, 0, cx], [0, fy * 1.1, cy], [0, 0, 1]])
    asked(far)
    assert "dataset.intrinsics times 1.100 would agree" in capsys.readouterr().out


def test_poses_are_as_sure_as_is_said_in_the_unit_of_the_prediction(own, capsys):
    assert asked(own)[1][0].pose_covariance is None
    assert UNKNOWN in capsys.readouterr().out
    prior, predictions = asked(own, pose_std=[0.02, 3.0], scale="arbitrary", median_depth=20.0)
    assert "prior.pose_std=[0.02,3]" in capsys.readouterr().out
    assert prior.provenance.settings["pose_std"] == [0.02, 3.0]
    factor = predictions[0].points[..., 2].max() / asked(own)[1][0].points[..., 2].max()
    expected = np.diag(np.repeat([(0.02 * factor) ** 2, np.radians(3.0) ** 2], 3))
    for prediction in predictions:
        shape = (len(prediction.window.views), 6, 6)
        np.testing.assert_allclose(prediction.pose_covariance, np.broadcast_to(expected, shape), rtol=1e-5)
    poses = {"T_world_camera": lambda f: f.T_world_camera * (np.nan if f.index == 2 else 1.0)}
    lost = write_npz(own.parent / "lost", NAMES, **poses)
    _, predictions = asked(lost, pose_std=[0.02, 3.0])
    assert np.isnan(predictions[0].pose_covariance[list(predictions[0].window.views).index(2)]).all()


@pytest.mark.parametrize("wrong", [0.1, [0.1], [0.1, -1], [np.nan, 1], "much", [1, 2, 3]])
def test_an_uncertainty_that_is_no_length_and_angle_is_refused(wrong, own):
    with pytest.raises(ValueError, match=r"prior.pose_std must be \[length, degrees\]"):
        asked(own, pose_std=wrong)


def test_the_script_of_the_documentation_writes_what_the_prior_reads(tmp_path, monkeypatch):
    """Against the truth, with a model that knows it."""
    page = (tiny_run.CONF.parent / "docs" / "predictions.md").read_text()
    section = page[page.index("## One file a frame") :]
    script = section[section.index("```python\n") + 10 :].partition("```")[0]
    assert len([line for line in script.splitlines() if line]) <= 10
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    names = sorted(NAMES)  # as the script orders them
    for name in names:
        Path("images", f"{name}.jpg").touch()
    frames = [truth()[NAMES.index(name)] for name in names]

    def my_model(images):
        assert [image.stem for image in images] == names
        depths, poses = (np.stack([getattr(f, key) for f in frames]) for key in ("depth", "T_world_camera"))
        return depths, depths + 1, poses, np.tile(tiny_run.dataset().intrinsics, (len(frames), 1))

    exec(script, {"my_model": my_model})
    _, predictions = asked(tmp_path / "predictions")
    for prediction in predictions:
        views, dense = list(prediction.window.views), list(prediction.window.dense)
        poses = relative_poses([truth()[index].T_world_camera for index in views])
        np.testing.assert_allclose(prediction.T_anchor_view, poses, atol=1e-12)
        depth = np.stack([truth()[index].depth for index in dense])
        np.testing.assert_allclose(prediction.points[..., 2], depth, rtol=1e-6)
        np.testing.assert_allclose(prediction.confidence, depth + 1, rtol=1e-6)
