"""Files of predictions are of the images on disk; where these are straightened, so are the files."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from emgs_jax.data.images import Images
from emgs_jax.data.reading import resize_nearest
from emgs_jax.prior.base import calls_of, with_frames
from emgs_jax.prior.files.prior import Files
from emgs_jax.prior.files.stream import Stream
from emgs_jax.prior.files.view import Camera, View, at_frame, by_rays, whole_image
from emgs_jax.prior.multiview.depth_files import _reader, open_depths

SIZE = (320, 240)
SPOTS = ((30, 25), (290, 30), (160, 120), (35, 215), (295, 210))  # the outer ones move by 4 to 5 pixels
CAMERA = [250.0, 250.0, 159.5, 119.5, -0.1, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Images with bright spots, .npz beside them in which these are nearer, and the depths alone in depths/."""
    found = tmp_path_factory.mktemp("distorted")
    (found / "depths").mkdir()
    image, depth = np.full((*SIZE[::-1], 3), 40, np.uint8), np.full(SIZE[::-1], 3.0, np.float32)
    for spot in SPOTS:
        cv2.circle(image, spot, 6, (255, 255, 255), -1)
        cv2.circle(depth, spot, 6, 1.5, -1)
    for number in range(4):
        pose = np.eye(4)
        pose[0, 3] = 0.01 * number
        cv2.imwrite(str(found / f"a{number}.png"), image)
        np.savez(found / f"a{number}.npz", depth=depth, T_world_camera=pose)
        np.save(found / "depths" / f"a{number}.npy", depth)
    return found


def depths_alone(dataset: Images, folder: Path) -> np.ndarray:
    return _reader(dataset, open_depths(folder / "depths", "metric", 1000.0), folder)(0)


def predicted(prior: Files | Stream, dataset: Images) -> np.ndarray:
    prior.check(dataset, 2)
    window, frames = next(iter(with_frames(calls_of(prior, dataset, 2), dataset)))
    points = prior.predict(window, [*frames.values()], dataset.intrinsics).points[0]
    fx, fy, cx, cy = dataset.intrinsics
    rows, columns = np.indices(points.shape[:2])
    np.testing.assert_allclose(points[..., 0], (columns - cx) / fx * points[..., 2], atol=1e-5)  # on the frame's rays
    np.testing.assert_allclose(points[..., 1], (rows - cy) / fy * points[..., 2], atol=1e-5)
    return points[..., 2]


def with_poses(dataset: Images, folder: Path) -> np.ndarray:
    return predicted(Files(folder, "auto", 2.0, 1000.0, 0.03, pose_std=[0, 0], max_misfit=10.0), dataset)


def beside_images(dataset: Images, folder: Path) -> np.ndarray:
    return predicted(Stream(max_misfit=10.0), dataset)


@pytest.mark.parametrize("depth_of", [depths_alone, with_poses, beside_images])
@pytest.mark.parametrize("size", [SIZE, (160, 120)])
def test_depths_are_where_their_image_has_them(folder, size, depth_of: Callable[[Images, Path], np.ndarray]):
    dataset = Images(str(folder), size=size, intrinsics=CAMERA)
    bright, near = dataset[0].image[..., 0] > 150, depth_of(dataset, folder) < 2.0
    assert (bright & near).sum() > 0.85 * (bright | near).sum()
    as_it_is = resize_nearest(np.load(folder / "depths" / "a0.npy"), size) < 2.0
    assert (bright & as_it_is).sum() < 0.6 * (bright | as_it_is).sum()  # the spots are small enough to tell


def test_points_of_a_file_stay_as_they_are(folder):
    dataset = Images(str(folder), size=SIZE, intrinsics=CAMERA)
    points = np.stack([*np.meshgrid(np.arange(320.0), np.arange(240.0)), np.full(SIZE[::-1], 2.0)], axis=-1)
    camera = Camera(SIZE, dataset.intrinsics)
    found, _, mask = at_frame(View("a", points), camera, whole_image, 0.5, dataset.stored_pixels(0))
    stored = dataset.stored_pixels(0) * SIZE - 0.5
    inner = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(found[..., :2][inner], stored[inner], atol=1e-3)
    assert mask[inner].all()


def test_files_of_images_that_another_program_straightened_are_matched_by_rays(folder, monkeypatch):
    prior, places = Files(folder, "auto", 2.0, 1000.0, 0.03, pose_std=[0, 0], max_misfit=10.0), []
    found = prior._found
    read = lambda row: View("a", np.full((60, 80), 2.0, np.float32), None, (60.0, 60.0, 39.5, 29.5))  # noqa: E731
    prior._found = type(found)(**vars(found) | {"is_straight": True, "read": read})
    monkeypatch.setattr(
        "emgs_jax.prior.files.prior.at_frame",
        lambda *given: places.append((given[2], given[4])) or at_frame(*given),
    )
    prior.check(Images(str(folder), size=SIZE, intrinsics=CAMERA), 2)
    assert places and all(place is by_rays and stored is None for place, stored in places)
    places.clear()
    prior.check(Images(str(folder), size=SIZE, intrinsics=CAMERA[:4]), 2)
    assert places and all(place is whole_image for place, _ in places)


def test_without_distortion_an_image_is_only_resized(folder):
    assert Images(str(folder), size=(160, 120), intrinsics=CAMERA[:4]).stored_pixels(0) is None
