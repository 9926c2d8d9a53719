"""Bags of ROS 1 and 2, written by rosbags' own writers; oracles: the pictures that were written, dataset=images."""

import sys
from types import SimpleNamespace
from unittest.mock import ANY

import cv2
import numpy as np
import pytest
from written_scene import color_image

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.rosbag import RECTIFIED, RosBag, to_rgb, when_taken

rosbags = pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
from tests.data.written_bag import SIZE, D, K, P, write_bag  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("lens", [("plumb_bob", D), ("equidistant", D[:4], "OPENCV_FISHEYE")], ids=lambda lens: lens[0])
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_images_and_camera_are_those_that_were_recorded(version, kind, lens, tmp_path):
    model, bent, *colmaps = lens
    path = write_bag(tmp_path, version, kind, model=model, bent=bent)
    dataset = RosBag(str(path), size=SIZE)
    (tmp_path / "images").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), color_image(i, SIZE))
    same = Images(str(tmp_path / "images"), size=SIZE, intrinsics=[*colmaps, K[0], K[4], K[2], K[5], *bent])
    np.testing.assert_allclose(dataset.intrinsics, same.intrinsics)
    assert len(dataset) == 3 and not dataset.has_ground_truth
    for index in (2, 0, 1):
        np.testing.assert_array_equal(dataset[index].image, same[index].image)
        assert dataset[index].timestamp == pytest.approx(1 + index / 10)
    assert dataset.fingerprint() == RosBag(str(path), size=SIZE).fingerprint()
    assert dataset.fingerprint() != RosBag(str(path), size=SIZE, stride=2).fingerprint()


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_images_come_in_the_order_and_at_the_times_at_which_they_were_taken(version, kind, tmp_path):
    """The second arrives last; the stamps of the bag are those of its recorder."""
    path = write_bag(tmp_path, version, kind, late=(80_000_000, 310_000_000, 90_000_000))
    dataset = RosBag(str(path), size=SIZE)
    straight = RosBag(str(write(tmp_path / "straight", version=version, kind=kind)), size=SIZE)
    for index in (0, 1, 2):
        np.testing.assert_array_equal(dataset[index].image, straight[index].image)
        assert dataset[index].timestamp == pytest.approx(1 + index / 10)
    assert RosBag(str(path), size=SIZE, stride=2)[1].timestamp == pytest.approx(1.2)
    assert "note" not in dataset.calibration


def test_without_stamps_the_time_is_that_of_the_recording_and_a_note_says_so():
    received = [10, 20, 30]
    for stamps in ([0, 0, 0], [7, 7, 7]):
        assert when_taken(received, stamps) == (received, ANY) and "no times" in when_taken(received, stamps)[1]
    assert when_taken(received, [5, 0, 24]) == ([5, 20 - 5, 24], None)  # 5 and 6 late
    assert when_taken([], []) == ([], None) and when_taken([10], [4]) == ([4], None)


@pytest.mark.parametrize("encoding", ["8UC1", "8UC3", "mono16"])
def test_encodings_without_an_order_of_colours_are_opencvs_own_and_16_bits_are_stretched(encoding, tmp_path):
    dataset = RosBag(str(write_bag(tmp_path, encoding=encoding, bent=D[:0])), size=SIZE)
    for index in range(3):
        image, true = dataset[index].image[..., ::-1].astype(int), color_image(index, SIZE).astype(int)
        if encoding == "8UC3":
            np.testing.assert_array_equal(image, true)
            continue
        green = true[..., 1]
        expected = green if encoding == "8UC1" else green * 255 / 119  # 119 is the brightest, 0 the darkest
        np.testing.assert_allclose(image, np.repeat(expected[..., None], 3, -1), atol=3)
    assert ("more than 8 bits" in dataset.calibration.get("note", "")) == (encoding == "mono16")


def test_without_a_camera_it_is_the_one_that_is_given(tmp_path):
    dataset = RosBag(write(tmp_path / "bare", info=False), size=SIZE, intrinsics=[130, 128, 80.5, 59])
    np.testing.assert_array_equal(dataset[1].image[..., ::-1], color_image(1, SIZE))


def write(folder, **options):
    folder.mkdir()
    return str(write_bag(folder, **options))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_a_rectified_topic_has_the_camera_that_it_was_made_for(version, kind, tmp_path):
    """Symptom: it was straightened once more, with the raw image's K; and 'take the rectified topic' led nowhere."""
    path = write_bag(tmp_path, version, kind, name="rect_color", model="equidistant", bent=D[:4])
    dataset = RosBag(str(path), size=SIZE)
    np.testing.assert_allclose(dataset.intrinsics, [P[0], P[5], P[2], P[6]])
    np.testing.assert_array_equal(dataset[1].image[..., ::-1], color_image(1, SIZE))


def test_what_is_rectified_is_told_by_a_word_of_the_topic():
    for topic in ("/cam/image_rect", "/cam/image_rect_color/compressed", "/zed/rgb/color/rect/image"):
        assert RECTIFIED.search(topic), topic
    for topic in ("/cam/image_raw", "/direct/color", "/correct_cam/rgb/compressed", "/cam/image_corrected"):
        assert not RECTIFIED.search(topic), topic


def test_a_damaged_bag_and_a_missing_library_are_clear(tmp_path, monkeypatch):
    path = write_bag(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="walk.bag is no bag that can be read"):
        RosBag(str(path))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ValueError, match=r'pip install "emgs_jax\[rosbag\]"'):
        RosBag(str(path))


@pytest.mark.parametrize("form", ["16UC1; compressedDepth png", "16UC1; jpeg compressed ", "32FC1; compressedDepth"])
def test_depths_that_are_compressed_are_no_pictures(form):
    """A bag with one compressed topic, the depths, was mapped from pictures of depths, or was called damaged."""
    picture = SimpleNamespace(format=form, data=cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1])
    with pytest.raises(BadFrameError, match=r"one has the encoding '(16U|32F)C1' \(depths\), .*another dataset.topic"):
        to_rgb(picture, True, "one")
    picture.format = "bgr8; jpeg compressed bgr8"
    assert to_rgb(picture, True, "one").shape == (4, 4, 3)
