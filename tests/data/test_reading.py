"""Choosing, resizing and checking of files on disk."""

import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from emgs_jax.data import reading
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.file_names import natural_key
from emgs_jax.data.tones import read_shown

RAMP = np.stack([*np.meshgrid(np.arange(64), np.arange(48)), np.zeros((48, 64))], axis=-1).astype(np.uint8)


def encode(suffix, image=RAMP):
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize("size", [(32, 24), (16, 24), (64, 48)])
def test_colour_shows_a_point_where_the_resized_intrinsics_project_it(size):
    # Each pixel's value is its own raw position, so the small image says which raw position each new pixel shows.
    small = reading.resize_color(RAMP, size).astype(float)
    _, _, cx, cy = reading.resize_intrinsics((1.0, 1.0, 20.0, 30.0), (64, 48), size)
    np.testing.assert_allclose(np.interp(cx, np.arange(size[0]), small[0, :, 0]), 20.0, atol=0.51)  # uint8 rounding
    np.testing.assert_allclose(np.interp(cy, np.arange(size[1]), small[:, 0, 1]), 30.0, atol=0.51)
    halved = reading.resize_intrinsics((525.0, 520.0, 320.0, 240.0), (640, 480), (320, 240))
    np.testing.assert_allclose(halved, (262.5, 260.0, 159.75, 119.75), rtol=1e-12)


@pytest.mark.parametrize("size", [(32, 24), (34, 18), (100, 90)])
def test_nearest_takes_the_pixel_that_holds_the_new_centre(size):
    columns = reading.resize_nearest(RAMP[..., 0].astype(np.uint16), size)[0].astype(float)
    centres = (np.arange(size[0]) + 0.5) * 64 / size[0] - 0.5
    assert np.abs(columns - centres).max() <= 0.5


@pytest.mark.parametrize("size", [(320, 240), (160, 120), (213, 160), (640, 480), (500, 375)])
def test_depth_of_a_plane_stays_on_it(size):
    """Every lower right pixel of four was 3 mm before a floor, in all of TUM and 7-Scenes at 320x240."""
    intrinsics, normal = (525.0, 525.0, 319.5, 239.5), np.array([0.0, 0.42, 0.91])
    depth = (1.5 / (backproject(np.ones((480, 640)), intrinsics) @ normal)).astype(np.float32)
    resized = reading.resize_nearest(depth, size)
    own = backproject(resized, reading.resize_intrinsics(intrinsics, (640, 480), size)) @ normal
    np.testing.assert_allclose(own, 1.5, atol=1e-6)
    assert resized.dtype == np.float32 and (size != (640, 480) or (resized == depth).all())


def test_depths_and_labels_at_an_edge_are_of_one_side_the_same_one_and_that_of_most_pixels():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, (40, 60)).astype(np.int32)
    small, found = (reading.resize_nearest(v, (30, 20)) for v in (labels.astype(np.float32), labels))
    np.testing.assert_array_equal(small, found, err_msg="depths 0 (unknown) and 1")
    shares = labels.reshape(20, 2, 30, 2).mean((1, 3))
    np.testing.assert_array_equal(found, np.where(shares == 0.5, labels[1::2, 1::2], shares > 0.5))


def test_files_sort_by_their_numbers(tmp_path):
    names = ["f10.png", "F2.png", "f1.png", "a.png", "f1b.png"]
    ordered = sorted((tmp_path / n for n in names), key=natural_key)
    assert [p.name for p in ordered] == ["a.png", "f1.png", "f1b.png", "F2.png", "f10.png"]


def test_start_stop_and_stride_are_a_slice():
    for start, stop, stride in ((0, None, 1), (3, 9, 2), (9, 10, 5), (0, 10, 10)):
        assert list(reading.select(10, start, stop, stride, "x")) == list(range(10))[start:stop:stride]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_every_truncation_of_an_image_is_found_and_named(suffix, tmp_path):
    data, path = encode(suffix), tmp_path / f"cut{suffix}"
    path.write_bytes(data)
    assert read_shown(path, (64, 48), None).shape == (48, 64, 3)
    for length in [*range(0, len(data) - 2, max(1, len(data) // 60)), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(BadFrameError, match=path.name):
            read_shown(path, None, None)


def test_a_truncated_jpeg_is_found_behind_a_whole_thumbnail(tmp_path):
    thumbnail, data, path = encode(".jpg", RAMP[:8, :8]), encode(".jpg"), tmp_path / "exif.jpg"
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    path.write_bytes(data)
    np.testing.assert_array_equal(read_shown(path, None, None), cv2.imread(str(path))[..., ::-1])
    path.write_bytes(data[:-200])
    with pytest.raises(BadFrameError, match="truncated"):
        read_shown(path, None, None)


def test_depth_is_metres_with_both_marks_of_the_sensor_zero_and_what_is_no_depth_image_is_refused(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.array([[0, 1500, 65535, 65534]], np.uint16))
    np.testing.assert_allclose(reading.read_depth(path, 1000.0, (4, 1)), [[0, 1.5, 0, 65.534]], rtol=1e-6)
    flipped = bytearray(encode(".png", np.full((48, 64), 2000, np.uint16)))
    flipped[60] ^= 4  # one bit
    for content, size, message in (
        (flipped, (64, 48), "checksum"),
        (encode(".png", np.zeros((4, 4), np.uint8)), (4, 4), "16-bit"),
        (encode(".png", np.zeros((4, 4), np.uint16)), (8, 4), "is 4x4, but .* are 8x4"),
    ):
        path.write_bytes(content)
        with pytest.raises(BadFrameError, match=message):
            reading.read_depth(path, 1000.0, size)


def test_a_rounded_pose_becomes_the_nearest_rotation_and_one_of_lost_tracking_is_no_truth():
    angle = 0.3
    exact = np.eye(4)
    exact[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose = reading.as_pose(" ".join(f"{v:.4f}" for v in exact.ravel()), "x")
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose, exact, atol=1e-4)
    for value in ("inf", "-inf", "nan"):
        assert reading.as_pose(f"{value} 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt") is None


def test_a_pose_that_is_none_or_whose_position_float32_does_not_hold_names_its_file():
    for value in ("1.1", "-1", "1e300"):
        with pytest.raises(BadFrameError, match="frame-7.pose.txt"):
            reading.as_pose(f"{value} 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt")
    for value in ("1.1e3", "-1e6", "1e300"):
        with pytest.raises(ValueError, match=r"frame-7\.pose\.txt has a position of .* geo-referenced") as caught:
            reading.as_pose(f"1 0 0 {value}  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt")
        assert not isinstance(caught.value, BadFrameError), "or on_bad_frame=skip would leave out everything"
    assert reading.as_pose("1 0 0 -999  0 1 0 0  0 0 1 0  0 0 0 1", "x")[0, 3] == -999


def test_the_fingerprint_is_of_names_contents_and_options_not_of_the_place(tmp_path):
    def fingerprint(folder, *contents, size=(4, 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        files = [tmp_path / folder / f"{number}.png" for number in range(3)]
        for file, content in zip(files, contents, strict=False):
            file.write_bytes(content)
        return reading.fingerprint(tmp_path / folder, files, {"size": size})

    whole = bytes(range(256))
    one = fingerprint("a", whole, whole, whole)
    assert one == fingerprint("b", whole, whole, whole) != fingerprint("a", size=(3, 4))
    assert one != fingerprint("a", whole, whole[:-1] + b"\0"), "one byte of one file, as long as it was"
    assert one == fingerprint("a", whole, whole)
    assert fingerprint("c", whole, whole) != fingerprint("c", whole, whole, b""), "a missing file is no empty one"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\0\0\0\x18ftyphevx\0\0\0\0mif1heic", "an image in HEIC"),
        (b"\0\0\0\x18ftypisom\0\0\0\0isommp42", "a video"),
        (b"\0\0\0\x18ftypavis\0\0\0\0avifmif1", "an image in AVIF"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "an image in JPEG XL"),
        (b"version https://git-lfs.github.com/spec/v1", "a pointer of Git LFS"),
    ],
)
def test_a_file_is_what_it_holds_whatever_its_name_says(content, words):
    assert reading.other_kind(content + bytes(99)).startswith(words)


@pytest.mark.parametrize("kind", ["RGBA", "LA", "RGB", "L", "P"])  # the last three have a colour that is none (tRNS)
def test_transparency_of_any_image_is_told(kind, tmp_path):
    paths = [tmp_path / name for name in ("a.jpg", "b.png", "c.png", "d.png")]
    image = Image.fromarray(np.zeros((48, 64, 3), np.uint8)).convert(kind)
    some = {"RGB": (0, 0, 0)}.get(kind, 0)
    Image.fromarray(RAMP).save(paths[0]), Image.fromarray(RAMP).save(paths[1])
    image.save(paths[2])
    if "A" in kind:
        image.putalpha(
            Image.fromarray(np.where(np.arange(64) < 32, 0, 255).astype(np.uint8) * np.ones((48, 1), np.uint8))
        )
    image.save(paths[3], **({} if "A" in kind else {"transparency": some}))
    assert reading.transparency_note(paths[:3]) is None
    assert reading.transparency_note(paths).startswith("d.png is transparent")


def test_the_orientation_of_an_image_is_that_of_its_exif(tmp_path):
    image = Image.fromarray(RAMP)
    for number in (1, 3, 6, 9):
        exif = image.getexif()
        exif[0x0112] = number
        image.save(tmp_path / "a.jpg", exif=exif)
        assert reading.orientation(tmp_path / "a.jpg") == (number if number < 9 else 1)
    assert reading.orientation(tmp_path / "none.jpg") == 1
