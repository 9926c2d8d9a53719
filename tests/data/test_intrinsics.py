"""What dataset.intrinsics may be; OpenCV's points and pycolmap's EXIF rule are the oracles."""

import json

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from test_calibration_files import TRANSFORMS

from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import Pictures, find_lens, undistortion
from emgs_jax.data.replica import Replica
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum

SIZE, CAMERA = (160, 120), (128.0, 125.0, 78.0, 61.0)
LENSES = {"barrel": (-0.25, 0.05, 0.002, -0.001), "pincushion": (0.15, 0.02, -0.001, 0.002, 0.01)}
DOT = np.array([[30.0, 25.0], [80.0, 60.0], [131.0, 96.0]])


def dots() -> np.ndarray:
    """Soft white dots at DOT."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    spots = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8) for x, y in DOT)
    return np.repeat(np.rint(255 * np.minimum(spots, 1))[..., None], 3, axis=-1).astype(np.uint8)


def center_of_dot(image, near) -> np.ndarray:
    u, v = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    weight = image[..., 0] * ((u - near[0]) ** 2 + (v - near[1]) ** 2 < 100.0)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def straight_pixels(pixels, intrinsics, lens, new):
    """Where OpenCV moves distorted pixels."""
    old = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    rays = cv2.undistortPoints(np.array(pixels)[:, None], old, np.array(lens))[:, 0]
    return rays * new[:2] + new[2:]


def folder_of(tmp_path, **exif):
    """Three images with the dots, and EXIF tags by name."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(3):
        image, tags = Image.fromarray(dots()), Image.Exif()
        for name, value in exif.items():
            if name == "Orientation":
                tags[ExifTags.Base.Orientation] = value
            else:
                tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name]] = value
        image.save(folder / f"{i}.jpg", exif=tags, quality=95)
    return folder


def load(folder, intrinsics, **options):
    return Images(str(folder), intrinsics=intrinsics, **{"size": SIZE, **options})


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_a_point_is_where_opencv_undistorts_it_to(lens, tmp_path):
    dataset = load(folder_of(tmp_path), (*CAMERA, *lens))
    image, expected = dataset[0].image, straight_pixels(DOT, CAMERA, lens, dataset.intrinsics)
    for pixel in expected:
        np.testing.assert_allclose(center_of_dot(image, pixel), pixel, atol=0.1)  # JPEG, and the dot's own bending
    assert np.abs(expected - DOT).max() > 2
    straight = load(dataset._source.folder, CAMERA)
    assert dataset.fingerprint() != straight.fingerprint()
    assert dataset.calibration["distortion"] == list(lens)


def test_numbers_of_no_distortion_change_nothing(tmp_path):
    folder = folder_of(tmp_path)
    bent, straight = load(folder, (*CAMERA, 0, 0, 0, 0)), load(folder, CAMERA)
    assert bent.intrinsics == straight.intrinsics == pytest.approx(CAMERA)
    np.testing.assert_array_equal(bent[0].image, straight[0].image)
    assert bent.fingerprint() == straight.fingerprint()


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_no_pixel_of_a_straight_image_was_invented(lens):
    white = np.full((*SIZE[::-1], 3), 255, np.uint8)
    _, maps = undistortion(CAMERA, lens, SIZE)
    assert cv2.remap(white, *maps, cv2.INTER_LINEAR).mean() > 254


@pytest.mark.parametrize("lens", [(-9, 0, 0, 0), (50, 0, 0, 0), (0, 0, 2, 0), (0, -80, 0, 0), (-0.4, 0, 0, 0, 9)])
def test_distortion_that_leaves_no_valid_pixel_is_refused(lens, tmp_path):
    with pytest.raises(ValueError, match=r"dataset.intrinsics: the distortion .* leaves . % of the 160x120 image"):
        load(folder_of(tmp_path), (*CAMERA, *lens))


@pytest.mark.parametrize(
    "given", [[1, 2, 3], [100, 100, 80, 60, 0.1], [np.nan, 100, 80, 60], [*CAMERA, np.inf, 0, 0, 0], [0, 100, 80, 60]]
)
def test_numbers_that_are_no_camera_name_the_key(given, tmp_path):
    with pytest.raises(ValueError, match=r"dataset.intrinsics must be \[fx, fy, cx, cy\]"):
        load(folder_of(tmp_path), given)


def test_a_file_gives_the_camera_and_says_so(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text("1 OPENCV 160 120 128 125 78.5 61.5 -.25 .05 .002 -.001\n")
    from_file, from_numbers = (
        load(tmp_path / "photos" if (tmp_path / "photos").exists() else folder_of(tmp_path), given)
        for given in (str(path), (*CAMERA, *LENSES["barrel"]))
    )
    assert from_file.intrinsics == from_numbers.intrinsics
    np.testing.assert_array_equal(from_file[1].image, from_numbers[1].image)
    assert from_file.fingerprint() == from_numbers.fingerprint()
    assert from_file.calibration["source"] == "cameras.txt"
    assert "cameras.txt" in from_file.calibration["note"]


def test_a_file_for_images_of_another_size_is_refused(tmp_path):
    path = tmp_path / "cameras.txt"
    folder = folder_of(tmp_path)
    for size, reason in (("320 240", "images in that size"), ("120 160", "EXIF orientation")):
        path.write_text(f"1 SIMPLE_PINHOLE {size} 100 60 60\n")
        with pytest.raises(ValueError, match=f"cameras.txt is for images of .* images are 160x120.*{reason}"):
            load(folder, str(path))
    path.write_text("1 SIMPLE_PINHOLE 160 120 100 500 60\n")
    with pytest.raises(ValueError, match="cameras.txt .* principal point outside of the 160x120"):
        load(folder, str(path))


def test_exif_follows_the_diagonal(tmp_path):
    """pycolmap: 26 mm at 4032x3024 are 3028 px, which are 120.2 at 160 wide; the centre is the middle."""
    dataset = load(folder_of(tmp_path, FocalLengthIn35mmFilm=26), "exif")
    np.testing.assert_allclose(dataset.intrinsics, (3028 / 25.2, 3028 / 25.2, 79.5, 59.5), rtol=1e-3)
    assert dataset.calibration["source"] == "exif"


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_turned_photo_has_the_focal_length_and_the_middle_of_what_is_shown(orientation, tmp_path):
    folder = folder_of(
        tmp_path, FocalLengthIn35mmFilm=26, Orientation=orientation, ExifImageWidth=160, ExifImageHeight=120
    )
    size = SIZE if orientation < 5 else SIZE[::-1]
    dataset = load(folder, "exif", size=size)
    assert dataset[0].image.shape[1::-1] == size
    np.testing.assert_allclose(dataset.intrinsics, (120.17, 120.17, (size[0] - 1) / 2, (size[1] - 1) / 2), rtol=1e-3)


@pytest.mark.parametrize("tags", [{}, {"FocalLength": 4.2}, {"FocalLengthIn35mmFilm": 0}])
def test_exif_without_a_focal_length_names_the_image_and_the_alternatives(tags, tmp_path):
    with pytest.raises(
        ValueError, match=r"0.jpg has no EXIF FocalLengthIn35mmFilm.*a calibration file, exif or estimate"
    ):
        load(folder_of(tmp_path, **tags), "exif")


def test_exif_of_a_crop_or_of_a_zoom_is_refused(tmp_path):
    folder = folder_of(tmp_path, FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=2268)
    with pytest.raises(ValueError, match="0.jpg was taken with 4032x2268 and cut to 160x120"):
        load(folder, "exif")
    for i in range(3):
        tags = Image.Exif()
        tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26 + i // 2
        Image.fromarray(dots()).save(folder / f"{i}.jpg", exif=tags)
    with pytest.raises(ValueError, match="several focal lengths .26 mm in 0.jpg, 27 mm in 2.jpg"):
        load(folder, "exif")
    assert load(folder, "exif", stop=2).calibration["source"] == "exif"


def test_a_damaged_photo_does_not_hide_the_exif_of_the_others(tmp_path):
    folder = folder_of(tmp_path, FocalLengthIn35mmFilm=26)
    (folder / "0.jpg").write_bytes((folder / "0.jpg").read_bytes()[:40])
    assert load(folder, "exif").intrinsics[0] == pytest.approx(120.17, rel=1e-3)


def test_a_video_has_no_exif(tmp_path):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, SIZE)
    writer.write(dots())
    writer.release()
    with pytest.raises(ValueError, match="a video has no EXIF: give dataset.intrinsics="):
        load(path, "exif")


def test_the_estimate_is_that_of_the_images_and_stands_in_the_calibration(tmp_path, monkeypatch):
    seen = []

    def estimate(count, read):
        seen.extend(read(i) for i in range(count))
        return type("Found", (), dict(value=130.0, spread=1.0, quartiles=(120.0, 140.0), num_pairs=25, num_images=3))

    monkeypatch.setattr("emgs_jax.data.intrinsics.estimate_focal_length", estimate)
    folder = folder_of(tmp_path)
    (folder / "1.jpg").write_bytes(b"")
    dataset = load(folder, "estimate")
    assert dataset.intrinsics == pytest.approx((130, 130, 79.5, 59.5))
    assert [image is None for image in seen] == [False, True, False]
    told = dataset.calibration
    assert (told["focal_px"], told["focal_deviation_px"], told["num_pairs"]) == (130.0, 1.0, 25)
    assert told["focal_quartiles_px"] == [120.0, 140.0]
    assert "130.0 px" in told["note"]


def test_true_depth_is_straightened_with_its_colour(tum_root, replica_root):
    """Both show the pixel that the map leads to; depths are never mixed."""
    lens = (-0.2, 0.05, 0.001, 0.001)
    scenes = [
        (Tum, tum_root, "rgbd_dataset_freiburg3_plane", (535.4, 539.2, 320.1, 247.6), (640, 480)),
        (Replica, replica_root, "office9", (60.0, 60.0, 59.5, 33.5), (120, 68)),
    ]
    for load_scene, root, name, camera, size in scenes:
        straight, bent = (
            load_scene(str(root), name, stride=1, size=size, intrinsics=given) for given in (camera, (*camera, *lens))
        )
        _, maps = undistortion(camera, lens, size)
        u, v = (np.clip(np.rint(m).astype(int), 0, limit - 1) for m, limit in zip(maps, size, strict=True))
        image, depth = bent[1].image, bent[1].depth
        # remap rounds to 1/32 pixel before it takes the nearest
        is_clear = (np.abs(np.stack(maps) % 1 - 0.5) > 0.04).all(axis=0)
        np.testing.assert_array_equal(depth[is_clear], straight[1].depth[v, u][is_clear])
        assert np.abs(image.astype(int) - straight[1].image[v, u]).max() <= 3
        assert set(np.unique(depth)) <= set(np.unique(straight[1].depth))


def test_registered_depth_is_that_of_the_straight_camera(seven_scenes_root, depth_gaps):
    lens = (0.1, -0.1, 0.001, 0.001)
    root, name = str(seven_scenes_root), "kitchen/seq-01"
    dataset = SevenScenes(root, name, stride=1, intrinsics=(525, 525, 320, 240, *lens))
    assert np.median(np.abs(depth_gaps(dataset, 0, 1))) < 0.005
    with pytest.raises(ValueError, match="distortion is the colour camera's.*set dataset.register_depth=true"):
        SevenScenes(root, name, stride=1, register_depth=False, intrinsics=(585, 585, 320, 240, *lens))


def test_distortion_of_tum_stands_in_one_place(tum_root, tmp_path):
    camera, lens, name = (535.4, 539.2, 320.1, 247.6), (0.1, -0.2, 0.0, 0.0, 0.1), "rgbd_dataset_freiburg3_plane"
    one = Tum(str(tum_root), name, stride=1, intrinsics=camera, distortion=lens)
    other = Tum(str(tum_root), name, stride=1, intrinsics=(*camera, *lens))
    np.testing.assert_array_equal(one[0].image, other[0].image)
    assert one.fingerprint() == other.fingerprint()
    for given in ((*camera, *lens), "exif"):
        with pytest.raises(ValueError, match="dataset.distortion goes with"):
            Tum(str(tum_root), name, stride=1, intrinsics=given, distortion=lens)


def test_every_data_set_on_disk_takes_a_file(tum_root, seven_scenes_root, tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(TRANSFORMS))
    for dataset in (
        Tum(str(tum_root), "rgbd_dataset_freiburg3_plane", stride=1, intrinsics=str(path)),
        SevenScenes(str(seven_scenes_root), "kitchen/seq-01", stride=1, intrinsics=str(path)),
    ):
        np.testing.assert_allclose(dataset.intrinsics[:2], (250.25, 251.125))
    with pytest.raises(FileNotFoundError, match="nothing.yaml cannot be read"):
        Tum(str(tum_root), "rgbd_dataset_freiburg3_plane", stride=1, intrinsics="nothing.yaml")


def test_what_is_said_of_a_camera_is_plain(tmp_path):
    lens = find_lens((*CAMERA, *LENSES["barrel"]), Pictures(SIZE, 0, lambda index: dots()))
    assert json.loads(json.dumps(lens.about)) == lens.about
    assert lens.about["intrinsics"] == list(CAMERA)
