"""Bags of ROS 1 and 2, written by rosbags' own writers; oracles: the pictures that were written, dataset=images."""

import sys

import cv2
import numpy as np
import pytest
from written_scene import color_image

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.rosbag import RECTIFIED, RosBag, to_rgb

rosbags = pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
from tests.data.written_bag import SIZE, D, K, P, write_bag  # noqa: E402


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_images_and_camera_are_those_that_were_recorded(version, kind, tmp_path):
    path = write_bag(tmp_path, version, kind)
    dataset = RosBag(str(path), size=SIZE)
    (tmp_path / "images").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), color_image(i, SIZE))
    same = Images(str(tmp_path / "images"), size=SIZE, intrinsics=[K[0], K[4], K[2], K[5], *D])
    np.testing.assert_allclose(dataset.intrinsics, same.intrinsics)
    assert len(dataset) == 3 and not dataset.has_ground_truth
    for index in (2, 0, 1):
        np.testing.assert_array_equal(dataset[index].image, same[index].image)
        assert dataset[index].timestamp == pytest.approx(1 + index / 10)
    assert dataset.fingerprint() == RosBag(str(path), size=SIZE).fingerprint()
    assert dataset.fingerprint() != RosBag(str(path), size=SIZE, stride=2).fingerprint()


def test_a_bag_without_camera_info_names_the_key_that_replaces_it(tmp_path):
    path = write_bag(tmp_path, info=False)
    with pytest.raises(ValueError, match=r"has no camera_info, so dataset.intrinsics must say the camera"):
        RosBag(str(path))
    dataset = RosBag(str(path), size=SIZE, intrinsics=[130, 128, 80.5, 59])
    np.testing.assert_array_equal(dataset[1].image[..., ::-1], color_image(1, SIZE))


def test_topics_are_chosen_and_those_that_are_there_are_named(tmp_path):
    path = write_bag(tmp_path)
    assert len(RosBag(str(path), topic="/cam/image_raw", info_topic="/cam/camera_info", size=SIZE)) == 3
    with pytest.raises(
        ValueError, match="no topic /eye of sensor_msgs/Image: give dataset.topic= one of /cam/image_raw"
    ):
        RosBag(str(path), topic="/eye")
    with pytest.raises(ValueError, match="dataset.info_topic= one of /cam/camera_info"):
        RosBag(str(path), info_topic="/eye")


def test_a_lens_or_encoding_that_is_not_read_is_refused(tmp_path):
    with pytest.raises(ValueError, match="distortion 'equidistant'.*dataset.intrinsics"):
        RosBag(str(write_bag(tmp_path, model="equidistant", bent=D[:4])))
    (tmp_path / "bayer").mkdir()
    with pytest.raises(ValueError, match="encoding 'bayer_rggb8'.*dataset.topic"):
        RosBag(str(write_bag(tmp_path / "bayer", encoding="bayer_rggb8")))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_a_rectified_topic_has_the_camera_that_it_was_made_for(version, kind, tmp_path):
    """Symptom: it was straightened once more, with the raw image's K; and 'take the rectified topic' led nowhere."""
    path = write_bag(tmp_path, version, kind, name="rect_color", model="equidistant", bent=D[:4])
    dataset = RosBag(str(path), size=SIZE)
    np.testing.assert_allclose(dataset.intrinsics, [P[0], P[5], P[2], P[6]])
    np.testing.assert_array_equal(dataset[1].image[..., ::-1], color_image(1, SIZE))


@pytest.mark.parametrize(
    ("topic", "is_rectified"),
    [
        ("/cam/image_rect", True),
        ("/cam/image_rect_color/compressed", True),
        ("/zed/rgb/color/rect/image", True),
        ("/cam/image_raw", False),
        ("/direct/color", False),
        ("/correct_cam/rgb/compressed", False),
        ("/cam/image_corrected", False),
    ],
)
def test_what_is_rectified_is_told_by_a_word_of_the_topic(topic, is_rectified):
    assert bool(RECTIFIED.search(topic)) == is_rectified


def test_a_rectified_topic_without_its_camera_is_refused(tmp_path):
    path = write_bag(tmp_path, name="rect", P=np.zeros(12))
    with pytest.raises(ValueError, match="no P for the rectified /cam/image_rect: give dataset.intrinsics"):
        RosBag(str(path))


def test_a_damaged_bag_and_a_missing_library_are_clear(tmp_path, monkeypatch):
    path = write_bag(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="walk.bag is no bag that can be read"):
        RosBag(str(path))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ValueError, match=r'pip install "emgs_jax\[rosbag\]"'):
        RosBag(str(path))


def test_an_image_that_is_shorter_than_it_says_is_a_bad_frame(tmp_path):
    message = type("Message", (), {"encoding": "rgb8", "width": 4, "height": 2, "step": 12, "data": np.zeros(23)})()
    with pytest.raises(BadFrameError, match="is not as large as it says"):
        to_rgb(message, False, "here")
