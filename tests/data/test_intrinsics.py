"""What dataset.intrinsics may be; OpenCV's points and pycolmap's EXIF rule are the oracles."""

import json

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from written_scene import center_of_dot, dots

from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.images import Images
from emgs_jax.data.replica import Replica
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum
from emgs_jax.data.undistortion import undistortion

SIZE, CAMERA = (160, 120), (128.0, 125.0, 78.0, 61.0)
LENSES = {"barrel": (-0.25, 0.05, 0.002, -0.001), "pincushion": (0.15, 0.02, -0.001, 0.002, 0.01)}
DOT = np.array([[30.0, 25.0], [80.0, 60.0], [131.0, 96.0]])
TUM = "rgbd_dataset_freiburg3_plane"


def straight_pixels(pixels, intrinsics, lens, new):
    """Where OpenCV moves distorted pixels."""
    old = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    rays = cv2.undistortPoints(np.array(pixels)[:, None], old, np.array(lens))[:, 0]
    return rays * new[:2] + new[2:]


def write_photo(path, **exif) -> None:
    """The dots, with EXIF tags by name."""
    tags = Image.Exif()
    for name, value in exif.items():
        if name == "Orientation":
            tags[ExifTags.Base.Orientation] = value
        else:
            tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name]] = value
    Image.fromarray(dots(DOT, SIZE)).save(path, exif=tags, quality=95)


def folder_of(tmp_path, **exif):
    folder = tmp_path / "photos"
    folder.mkdir(exist_ok=True)
    for i in range(3):
        write_photo(folder / f"{i}.jpg", **exif)
    return folder


def load(folder, intrinsics, **options):
    return Images(str(folder), intrinsics=intrinsics, **{"size": SIZE, **options})


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_a_point_is_where_opencv_undistorts_it_to_and_no_pixel_is_invented(lens, tmp_path):
    folder = folder_of(tmp_path)
    dataset, straight = load(folder, (*CAMERA, *lens)), load(folder, CAMERA)
    image, expected = dataset[0].image, straight_pixels(DOT, CAMERA, lens, dataset.intrinsics)
    for pixel in expected:
        np.testing.assert_allclose(center_of_dot(image, pixel), pixel, atol=0.1)  # JPEG, and the dot's own bending
    assert np.abs(expected - DOT).max() > 2
    assert dataset.fingerprint() != straight.fingerprint()
    about = json.loads(json.dumps(dataset.calibration))
    assert about["distortion"] == list(lens) and about["intrinsics"] == list(CAMERA)
    _, maps, _ = undistortion(Calibration(CAMERA, lens), SIZE)
    assert cv2.remap(np.full((*SIZE[::-1], 3), 255, np.uint8), *maps, cv2.INTER_LINEAR).mean() > 254
    none = load(folder, (*CAMERA, 0, 0, 0, 0))
    assert none.intrinsics == straight.intrinsics == pytest.approx(CAMERA)
    np.testing.assert_array_equal(none[0].image, straight[0].image)
    assert none.fingerprint() == straight.fingerprint()


def test_a_file_gives_the_camera_of_every_data_set_and_says_so(tum_root, seven_scenes_root, tmp_path):
    path, folder = tmp_path / "cameras.txt", folder_of(tmp_path)
    path.write_text("1 OPENCV 160 120 128 125 78.5 61.5 -.25 .05 .002 -.001\n")
    from_file, from_numbers = load(folder, str(path)), load(folder, (*CAMERA, *LENSES["barrel"]))
    assert from_file.intrinsics == from_numbers.intrinsics
    np.testing.assert_array_equal(from_file[1].image, from_numbers[1].image)
    assert from_file.fingerprint() == from_numbers.fingerprint()
    assert from_file.calibration["source"] == "cameras.txt" and "cameras.txt" in from_file.calibration["note"]
    path.write_text("1 PINHOLE 640 480 500.5 502.25 319.5 242\n")
    for dataset in (
        Tum(str(tum_root), TUM, stride=1, intrinsics=str(path)),
        SevenScenes(str(seven_scenes_root), "kitchen/seq-01", stride=1, intrinsics=str(path)),
    ):
        np.testing.assert_allclose(dataset.intrinsics[:2], (250.25, 251.125))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_exif_follows_the_diagonal_and_a_turned_photo_has_the_middle_of_what_is_shown(orientation, tmp_path):
    """pycolmap: 26 mm at 4032x3024 are 3028 px, which are 120.2 at 160 wide; the centre is the middle."""
    tags = {"FocalLengthIn35mmFilm": 26, "Orientation": orientation, "ExifImageWidth": 160, "ExifImageHeight": 120}
    folder, size = folder_of(tmp_path, **tags), SIZE if orientation < 5 else SIZE[::-1]
    dataset = load(folder, "exif", size=size)
    assert dataset[0].image.shape[1::-1] == size and dataset.calibration["source"] == "exif"
    focal, (w, h) = 3028 / 25.2, size
    np.testing.assert_allclose(dataset.intrinsics, (focal, focal, (w - 1) / 2, (h - 1) / 2), rtol=1e-3)
    (folder / "0.jpg").write_bytes((folder / "0.jpg").read_bytes()[:40])  # a damaged one does not hide the others'
    assert load(folder, "exif", size=size).intrinsics == dataset.intrinsics


def test_true_depth_is_straightened_with_its_colour(tum_root, replica_root):
    """Both show the pixel that the map leads to; depths are never mixed."""
    lens = (-0.2, 0.05, 0.001, 0.001)
    scenes = [
        (Tum, tum_root, TUM, (535.4, 539.2, 320.1, 247.6), (640, 480)),
        (Replica, replica_root, "office9", (60.0, 60.0, 59.5, 33.5), (120, 68)),
    ]
    for load_scene, root, name, camera, size in scenes:
        straight, bent = (
            load_scene(str(root), name, stride=1, size=size, intrinsics=given)[1]
            for given in (camera, (*camera, *lens))
        )
        _, maps, _ = undistortion(Calibration(camera, lens), size)
        u, v = (np.clip(np.rint(m).astype(int), 0, limit - 1) for m, limit in zip(maps, size, strict=True))
        # remap rounds to 1/32 pixel before it takes the nearest
        is_clear = (np.abs(np.stack(maps) % 1 - 0.5) > 0.04).all(axis=0)
        np.testing.assert_array_equal(bent.depth[is_clear], straight.depth[v, u][is_clear])
        assert np.abs(bent.image.astype(int) - straight.image[v, u]).max() <= 3
        assert set(np.unique(bent.depth)) <= set(np.unique(straight.depth))


def test_registered_depth_is_that_of_the_straight_camera(seven_scenes_root, depth_gaps):
    lens = (0.1, -0.1, 0.001, 0.001)
    root, name = str(seven_scenes_root), "kitchen/seq-01"
    dataset = SevenScenes(root, name, stride=1, intrinsics=(525, 525, 320, 240, *lens))
    assert np.median(np.abs(depth_gaps(dataset, 0, 1))) < 0.005


def test_distortion_of_tum_stands_in_one_place(tum_root):
    camera, lens = (535.4, 539.2, 320.1, 247.6), (0.1, -0.2, 0.0, 0.0, 0.1)
    one = Tum(str(tum_root), TUM, stride=1, intrinsics=camera, distortion=lens)
    other = Tum(str(tum_root), TUM, stride=1, intrinsics=(*camera, *lens))
    np.testing.assert_array_equal(one[0].image, other[0].image)
    assert one.fingerprint() == other.fingerprint()
