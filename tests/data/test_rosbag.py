"""Bags of ROS 1 and 2, written by rosbags' own writers; oracles: the pictures that were written, dataset=images."""

import sys

import cv2
import numpy as np
import pytest
from written_scene import color_image

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.rosbag import RosBag, to_rgb

rosbags = pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

SIZE = (160, 120)
K = [130.0, 0, 80.5, 0, 128.0, 59.0, 0, 0, 1]
D = [0.02, -0.004, 0.001, -0.002, 0.0]


def messages(store, version, kind, info=True, encoding="bgr8", model="plumb_bob", bent=D):
    """(topic, type, message, nanoseconds) of three images and a camera_info."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"](1, 0)
    extra = {"seq": 0} if version == 1 else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="cam", **extra)
    if info:
        letters = dict(zip("dkrp" if version == 2 else "DKRP", (bent, K, np.eye(3).ravel(), np.zeros(12)), strict=True))
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {name: np.array(value, np.float64) for name, value in letters.items()}
        info_type = types["sensor_msgs/msg/CameraInfo"]
        found = info_type(header, SIZE[1], SIZE[0], model, **values, binning_x=0, binning_y=0, roi=roi)
        yield "/cam/camera_info", "sensor_msgs/msg/CameraInfo", found, 5
    for i in range(3):
        image = color_image(i, SIZE)
        if kind == "Image":
            padded = np.pad(image.reshape(SIZE[1], -1), ((0, 0), (0, 4)))  # rows may be longer than the picture
            found = types["sensor_msgs/msg/Image"](header, *SIZE[::-1], encoding, 0, 3 * SIZE[0] + 4, padded.ravel())
            yield "/cam/image_raw", "sensor_msgs/msg/Image", found, int((1 + i / 10) * 1e9)
        else:
            data = cv2.imencode(".png", image)[1].ravel()
            found = types["sensor_msgs/msg/CompressedImage"](header, "png", data)
            yield "/cam/image_raw/compressed", "sensor_msgs/msg/CompressedImage", found, int((1 + i / 10) * 1e9)


def write_bag(folder, version=2, kind="Image", **options):
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    path = folder / ("walk.bag" if version == 1 else "walk")
    topics = {}
    with Writer1(path) if version == 1 else Writer2(path, version=9) as bag:
        for topic, msgtype, message, time in messages(store, version, kind, **options):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, msgtype, typestore=store)
            encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
            bag.write(topics[topic], time, encode(message, msgtype))
    return path


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
