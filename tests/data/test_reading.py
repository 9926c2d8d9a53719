"""Choosing, resizing and checking of files on disk."""

import struct

import cv2
import numpy as np
import pytest

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError

RAMP = np.stack([*np.meshgrid(np.arange(64), np.arange(48)), np.zeros((48, 64))], axis=-1).astype(np.uint8)


def encode(suffix, image=RAMP):
    return cv2.imencode(suffix, image)[1].tobytes()


def test_intrinsics_at_half_the_size_are_these_numbers():
    halved = reading.resize_intrinsics((525.0, 520.0, 320.0, 240.0), (640, 480), (320, 240))
    np.testing.assert_allclose(halved, (262.5, 260.0, 159.75, 119.75), rtol=1e-12)


@pytest.mark.parametrize("size", [(32, 24), (16, 24), (64, 48)])
def test_colour_shows_a_point_where_the_resized_intrinsics_project_it(size):
    # Each pixel's value is its own raw position, so the small image says which raw position each new pixel shows.
    small = reading.resize_color(RAMP, size).astype(float)
    _, _, cx, cy = reading.resize_intrinsics((1.0, 1.0, 20.0, 30.0), (64, 48), size)
    np.testing.assert_allclose(np.interp(cx, np.arange(size[0]), small[0, :, 0]), 20.0, atol=0.51)  # uint8 rounding
    np.testing.assert_allclose(np.interp(cy, np.arange(size[1]), small[:, 0, 1]), 30.0, atol=0.51)


@pytest.mark.parametrize("size", [(32, 24), (34, 18), (100, 90)])
def test_nearest_takes_the_pixel_that_holds_the_new_centre(size):
    columns = reading.resize_nearest(RAMP[..., 0].astype(np.uint16), size)[0].astype(float)
    centres = (np.arange(size[0]) + 0.5) * 64 / size[0] - 0.5
    assert np.abs(columns - centres).max() <= 0.5


def test_files_sort_by_their_numbers(tmp_path):
    names = ["f10.png", "F2.png", "f1.png", "a.png", "f1b.png"]
    ordered = sorted((tmp_path / n for n in names), key=reading.natural_key)
    assert [p.name for p in ordered] == ["a.png", "f1.png", "f1b.png", "F2.png", "f10.png"]


@pytest.mark.parametrize("start, stop, stride", [(0, None, 1), (3, 9, 2), (9, 10, 5), (0, 10, 10)])
def test_start_stop_and_stride_are_a_slice(start, stop, stride):
    assert list(reading.select(10, start, stop, stride, "x")) == list(range(10))[start:stop:stride]


@pytest.mark.parametrize(
    "start, stop, stride, key", [(10, None, 1, "start"), (-1, None, 1, "start"), (0, 11, 1, "stop"), (5, 5, 1, "stop")]
)
def test_a_value_out_of_range_names_its_key(start, stop, stride, key):
    with pytest.raises(ValueError, match=f"dataset.{key} must be"):
        reading.select(10, start, stop, stride, "x")
    with pytest.raises(ValueError, match="dataset.stride must be"):
        reading.select(10, 0, None, 0, "x")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_every_truncation_of_an_image_is_found_and_named(suffix, tmp_path):
    data, path = encode(suffix), tmp_path / f"cut{suffix}"
    path.write_bytes(data)
    assert reading.read_color(path, (64, 48)).shape == (48, 64, 3)
    for length in [*range(0, len(data) - 2, max(1, len(data) // 60)), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(BadFrameError, match=path.name):
            reading.read_color(path)


def test_a_truncated_jpeg_is_found_behind_a_whole_thumbnail(tmp_path):
    thumbnail, data, path = encode(".jpg", RAMP[:8, :8]), encode(".jpg"), tmp_path / "exif.jpg"
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    path.write_bytes(data)
    np.testing.assert_array_equal(reading.read_color(path), cv2.imread(str(path))[..., ::-1])
    path.write_bytes(data[:-200])
    with pytest.raises(BadFrameError, match="truncated"):
        reading.read_color(path)


def test_one_flipped_bit_in_a_depth_image_is_found(tmp_path):
    path = tmp_path / "depth.png"
    data = bytearray(encode(".png", np.full((48, 64), 2000, np.uint16)))
    data[60] ^= 4
    path.write_bytes(data)
    with pytest.raises(BadFrameError, match="checksum"):
        reading.read_depth(path, 1000.0, (64, 48))


def test_depth_is_metres_and_both_marks_of_the_sensor_are_zero(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.array([[0, 1500, 65535, 65534]], np.uint16))
    np.testing.assert_allclose(reading.read_depth(path, 1000.0, (4, 1)), [[0, 1.5, 0, 65.534]], rtol=1e-6)


def test_depth_of_eight_bits_or_of_another_size_is_refused(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    with pytest.raises(BadFrameError, match="16-bit"):
        reading.read_depth(path, 1000.0, (4, 4))
    cv2.imwrite(str(path), np.zeros((4, 4), np.uint16))
    with pytest.raises(BadFrameError, match="is 4x4, but .* are 8x4"):
        reading.read_depth(path, 1000.0, (8, 4))


def test_a_rounded_pose_becomes_the_nearest_rotation():
    angle = 0.3
    exact = np.eye(4)
    exact[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose = reading.as_pose(" ".join(f"{v:.4f}" for v in exact.ravel()), "x")
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose, exact, atol=1e-4)


@pytest.mark.parametrize("value", ["-1.#IND", "1.1", "-1", "1e300", ""])
def test_a_pose_that_is_none_names_its_file(value):
    with pytest.raises(BadFrameError, match="frame-7.pose.txt"):
        reading.as_pose(f"{value} 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt")


@pytest.mark.parametrize("value", ["inf", "-inf", "nan"])
def test_a_pose_of_lost_tracking_is_no_truth(value):
    assert reading.as_pose(f"{value} 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt") is None


@pytest.mark.parametrize("value", ["1e4", "-1e6", "1e300"])
def test_a_position_that_float32_does_not_hold_is_refused_and_never_skipped(value):
    with pytest.raises(ValueError, match=r"frame-7\.pose\.txt has a position of .* geo-referenced") as caught:
        reading.as_pose(f"1 0 0 {value}  0 1 0 0  0 0 1 0  0 0 0 1", "frame-7.pose.txt")
    assert not isinstance(caught.value, BadFrameError), "or on_bad_frame=skip would leave out everything"
    assert reading.as_pose("1 0 0 -500  0 1 0 0  0 0 1 0  0 0 0 1", "x")[0, 3] == -500


def test_the_fingerprint_is_of_names_contents_and_options_not_of_the_place(tmp_path):
    digests = []
    for name, text in (("a", "one"), ("b", "one"), ("c", "two")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "f.txt").write_text(text)
        digests.append(reading.fingerprint(tmp_path / name, [tmp_path / name / "f.txt"], {"size": (4, 3)}))
    assert digests[0] == digests[1] != digests[2]
    assert reading.fingerprint(tmp_path / "a", [tmp_path / "a" / "f.txt"], {"size": (3, 4)}) != digests[0]


def test_a_principal_point_outside_of_the_images_tells_that_the_size_is_wrong():
    with pytest.raises(ValueError, match="size of the images on disk"):
        reading.check_intrinsics((525, 525, 320, 240), (320, 240))


def test_one_changed_byte_of_one_file_changes_the_fingerprint(tmp_path):
    files = [tmp_path / f"{number}.png" for number in range(3)]
    for file in files:
        file.write_bytes(bytes(range(256)))
    before = reading.fingerprint(tmp_path, files, {})
    files[1].write_bytes(bytes(range(255)) + b"\0")  # as long as it is
    assert reading.fingerprint(tmp_path, files, {}) != before
    files[1].write_bytes(bytes(range(256)))
    assert reading.fingerprint(tmp_path, files, {}) == before


def test_a_missing_file_has_another_fingerprint_than_an_empty_one(tmp_path):
    missing = reading.fingerprint(tmp_path, [tmp_path / "f.png"], {})
    (tmp_path / "f.png").write_bytes(b"")
    assert reading.fingerprint(tmp_path, [tmp_path / "f.png"], {}) != missing
