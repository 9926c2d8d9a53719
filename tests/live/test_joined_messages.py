"""Messages of one moment, in any order; what their bytes mean. Oracles: what was written into them."""

import sys
import time
from array import array
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import BadFrameError
from emgs_jax.live import ros
from emgs_jax.live.joined_messages import Joined, pose_at
from emgs_jax.live.newest import Newest
from emgs_jax.live.ros import Frames, depth_of, image_of, pose_of
from emgs_jax.live.transforms import Transforms, stamp_of


def at(x: float, degrees: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    pose[0, 3] = x
    return pose


def test_an_image_alone_is_whole_at_once():
    joined = Joined(set())
    assert [*joined.add("image", 1.0, "a")] == [(1.0, {"image": "a"})] and joined.num_alone == 0


def test_an_image_waits_for_its_depth_and_for_the_pose_after_it():
    joined = Joined({"depth", "pose"})
    assert not [*joined.add("pose", 0.9, at(0.0))] and not [*joined.add("image", 1.0, "a")]
    assert not [*joined.add("depth", 0.95, "of another")], "50 ms apart is another moment"
    assert not [*joined.add("depth", 1.01, "its own")], "no pose has come that is later"
    ((time_s, found),) = joined.add("pose", 1.1, at(2.0, 90.0))
    assert time_s == 1.0 and found["image"] == "a" and found["depth"] == "its own"
    np.testing.assert_allclose(found["pose"], at(1.0, 45.0), atol=1e-9)


def test_what_becomes_whole_later_comes_in_order_of_time_and_what_does_not_is_counted():
    joined = Joined({"depth"})
    for number in range(4):
        assert not [*joined.add("image", 0.1 * number, number)]
    assert [found["image"] for _, found in joined.add("depth", 0.1, "d")] == [1]
    assert joined.num_alone == 1, "the first one's depth never came"
    joined._waiting["depth"].append((0.1 * 3, "early"))
    assert [found["image"] for _, found in joined.add("depth", 0.1 * 2, "d")] == [2, 3]


def test_an_image_does_not_take_the_depth_of_the_one_before_while_its_own_is_on_its_way():
    """At 60 images a second the one before is within 20 ms."""
    joined, found = Joined({"depth"}), []
    for number in range(4):
        found += joined.add("image", number / 60, number)
        found += joined.add("depth", number / 60 + 0.002, number)
    assert [(one["image"], one["depth"]) for _, one in found] == [(0, 0), (1, 1), (2, 2), (3, 3)]


@pytest.mark.parametrize("rate", [10, 200, 1000])
@pytest.mark.parametrize("late", [0.0, 0.35])
def test_odometry_of_any_rate_and_depths_that_come_late_are_joined(rate, late):
    joined, found, messages = Joined({"depth", "pose"}), [], []
    for number in range(60):
        messages += [(number / 30, "image", number / 30, number), (number / 30 + late, "depth", number / 30, number)]
    messages += [(number / rate, "pose", number / rate, at(number / rate)) for number in range(3 * rate)]
    for _, kind, time_s, value in sorted(messages, key=lambda one: one[:2]):
        found += joined.add(kind, time_s, value)
    assert [one["image"] for _, one in found] == [*range(60)] and joined.num_alone == 0
    assert all(one["depth"] == one["image"] for _, one in found)
    np.testing.assert_allclose([one["pose"][0, 3] for _, one in found], np.arange(60) / 30, atol=1e-9)


def test_messages_that_nothing_fits_do_not_pile_up():
    joined = Joined({"depth"})
    for number in range(1000):
        assert not [*joined.add("image", 0.1 * number, number)]
        assert not [*joined.add("depth", 0.1 * number + 0.05, "of no image")]
    assert all(len(kept) <= 32 for kept in joined._waiting.values()) and joined.num_alone > 900


def test_a_bag_that_is_played_again_begins_anew():
    joined, found = Joined({"depth"}), []
    for _ in range(2):
        for number in range(100):
            found += joined.add("depth", 0.1 * number, number)
            found += joined.add("image", 0.1 * number, number)
    assert [one["image"] for _, one in found] == 2 * [*range(100)]


def test_no_pose_is_guessed_outside_of_the_list_or_in_a_large_gap():
    poses = [(1.0, at(1.0)), (1.2, at(2.0)), (3.0, at(3.0))]
    assert pose_at(poses, 0.9) is None and pose_at(poses, 3.1) is None and pose_at([], 1.0) is None
    assert pose_at(poses, 2.0) is None, "1.8 s lie between the two"
    np.testing.assert_array_equal(pose_at(poses, 3.0), at(3.0))
    np.testing.assert_allclose(pose_at(poses, 1.05), at(1.25), atol=1e-9)


def message(values: np.ndarray, encoding: str, padding: int = 0, big: bool = False):
    """An Image whose rows have `padding` bytes at their end."""
    height, width = values.shape[:2]
    values = values.astype(values.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    facts = {"height": height, "width": width, "encoding": encoding, "step": rows.shape[1], "is_bigendian": big}
    return SimpleNamespace(**facts, data=array("B", rows.tobytes()))


RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


@pytest.mark.parametrize("padding", [0, 4])
def test_images_are_read_in_every_encoding(padding):
    np.testing.assert_array_equal(image_of(message(RGB, "rgb8", padding)), RGB)
    np.testing.assert_array_equal(image_of(message(RGB[..., ::-1], "bgr8", padding)), RGB)
    np.testing.assert_array_equal(image_of(message(RGB[..., 0], "mono8", padding)), RGB[..., [0, 0, 0]])
    data = cv2.imencode(".png", RGB[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(image_of(SimpleNamespace(format="png", data=data)), RGB)
    with pytest.raises(BadFrameError, match="encoding 'yuv422'"):
        image_of(message(RGB, "yuv422"))


@pytest.mark.parametrize("first", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_images_have_the_colours_of_their_pattern(first):
    """One colour everywhere: each pixel of the sensor shows its own channel of it."""
    color = {"r": 200, "g": 120, "b": 40}
    raw = np.empty((8, 8), np.uint8)
    for place, name in enumerate(first):
        raw[place // 2 :: 2, place % 2 :: 2] = color[name]
    found = image_of(message(raw, f"bayer_{first}8"))
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.broadcast_to([200, 120, 40], (4, 4, 3)))


@pytest.mark.parametrize("big", [False, True])
def test_depths_are_metres_and_0_where_there_is_none(big):
    np.testing.assert_allclose(
        depth_of(message(np.array([[0, 1500], [65535, 2]], np.uint16), "16UC1", 2, big)),
        [[0, 1.5], [65.535, 0.002]],
        rtol=1e-6,
    )
    raw = np.array([[np.nan, 1.5], [-1.0, np.inf]], np.float32)
    np.testing.assert_array_equal(depth_of(message(raw, "32FC1", 4, big)), np.float32([[0, 1.5], [0, 0]]))
    with pytest.raises(BadFrameError, match="encoding 'rgb8'"):
        depth_of(message(RGB, "rgb8"))


def transform(T: np.ndarray, **names):
    """Position and orientation of a pose as a message has them, under these names."""
    values = dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat(), strict=True))
    place, turn = SimpleNamespace(**dict(zip("xyz", T[:3, 3], strict=True))), SimpleNamespace(**values)
    return SimpleNamespace(**{names["place"]: place, names["turn"]: turn})


def odometry(T: np.ndarray, child: str, time_s: float = 12.25):
    stamp = SimpleNamespace(sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
    pose = SimpleNamespace(pose=transform(T, place="position", turn="orientation"))
    return SimpleNamespace(pose=pose, child_frame_id=child, header=SimpleNamespace(stamp=stamp, frame_id="odom"))


def transforms(links, time_s: float = 0.0):
    """A TFMessage of (parent, child, pose)."""
    stamp = SimpleNamespace(sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
    found = [
        SimpleNamespace(
            header=SimpleNamespace(frame_id=parent, stamp=stamp),
            child_frame_id=child,
            transform=transform(T, place="translation", turn="rotation"),
        )
        for parent, child, T in links
    ]
    return SimpleNamespace(transforms=found)


def random_pose(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return pose


def test_a_pose_and_a_stamp_are_those_of_the_message():
    T = random_pose(0)
    np.testing.assert_allclose(pose_of(odometry(T, "camera")), T, atol=1e-12)
    assert stamp_of(odometry(T, "camera")) == 12.25


def test_odometry_of_the_base_becomes_that_of_the_camera_where_tf_says_how_it_is_mounted():
    """Most robots publish the odometry of their base, which is not where the camera is."""
    frames, T_odom_base, T_base_mast, T_mast_camera = Frames(), *map(random_pose, range(3))
    image = message(RGB, "rgb8")
    image.header = SimpleNamespace(frame_id="camera_optical")
    with pytest.raises(ValueError, match="no image has come whose header names a frame"):
        frames.read_pose(odometry(T_odom_base, "base_link"))
    frames.see(image)
    with pytest.raises(ValueError, match="odometry is of the frame base_link, images are of camera_optical"):
        frames.read_pose(odometry(T_odom_base, "base_link"))
    np.testing.assert_allclose(frames.read_pose(odometry(T_odom_base, "camera_optical")), T_odom_base, atol=1e-12)
    links = [("base_link", "mast", T_base_mast), ("/mast", "/camera_optical", T_mast_camera)]
    frames.transforms.add_fixed(transforms(links))
    expected = T_odom_base @ T_base_mast @ T_mast_camera
    np.testing.assert_allclose(frames.read_pose(odometry(T_odom_base, "base_link")), expected, atol=1e-12)
    # Of a frame below the base that is no ancestor of the camera.
    frames.transforms.add_fixed(transforms([("base_link", "imu", random_pose(5))]))
    found = frames.read_pose(odometry(T_odom_base @ random_pose(5), "imu"))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_moving_camera_on_a_moving_base_is_where_both_are_at_the_time():
    """A camera on a head that turns: the transforms of both joints come at times of their own."""
    tree, T_head_camera = Transforms(), random_pose(3)
    tree.add_fixed(transforms([("head", "camera", T_head_camera)]))
    assert tree.pose("camera", "odom", 1.0) is None and tree.way("camera", "odom") == []
    assert not tree.add_moving(transforms([("odom", "base", at(1.0))], 1.0), "camera", "odom"), "no way yet"
    heads = [(0.9, at(0.0, 0.0)), (1.3, at(0.0, 40.0))]
    assert all(tree.add_moving(transforms([("/base", "/head", T)], t), "camera", "odom") for t, T in heads)
    assert not tree.add_moving(transforms([("base", "wheel", at(0))], 1.1), "camera", "odom"), "beside the way"
    assert tree.way("camera", "odom") == ["camera", "head", "base"]
    assert tree.pose("camera", "odom", 1.1) is None, "where the base is then has not come yet"
    assert tree.add_moving(transforms([("odom", "base", at(3.0)), ("base", "wheel", at(0))], 1.2), "camera", "odom")
    np.testing.assert_allclose(tree.pose("camera", "odom", 1.1), at(2.0) @ at(0.0, 20.0) @ T_head_camera, atol=1e-9)
    assert tree.pose("wheel", "camera", 1.1) is None, "the camera is not above the wheel"
    np.testing.assert_array_equal(tree.pose("odom", "odom", 1.1), np.eye(4))


def test_transforms_do_not_pile_up_begin_anew_and_frames_in_a_circle_lead_nowhere():
    tree = Transforms()
    for number in range(1000):
        tree.add_moving(transforms([("odom", "camera", at(number))], 0.05 * number), "camera", "odom")
    assert len(tree._moving["camera"][1]) <= 62
    tree.add_moving(transforms([("odom", "camera", at(7.0))], 0.0), "camera", "odom")  # a bag is played again
    np.testing.assert_array_equal(tree.pose("camera", "odom", 0.0), at(7.0))
    tree.add_fixed(transforms([("a", "b", at(0)), ("b", "a", at(0))]))
    assert tree.pose("a", "odom", 0.0) is None and tree.root("a")[0] in ("a", "b")


def test_an_image_takes_its_pose_from_transforms():
    tree, found = Transforms(), []
    joined = Joined({"pose"}, {"pose": lambda _, time_s: tree.pose("camera", "odom", time_s)})
    for number in range(4):
        found += joined.add("image", 0.25 * number, number)
        assert tree.add_moving(transforms([("odom", "camera", at(number))], 0.25 * number), "camera", "odom")
        found += joined.whole()
    assert [one["image"] for _, one in found] == [0, 1, 2, 3]
    np.testing.assert_allclose([one["pose"][0, 3] for _, one in found], np.arange(4), atol=1e-6)


@pytest.fixture
def topics(monkeypatch):
    """Subscribe without ROS: a function of the words, which returns the callbacks by topic and where images go."""

    def executor():
        return SimpleNamespace(add_node=lambda node: None, spin_once=lambda timeout_sec: time.sleep(0.01))

    of = SimpleNamespace
    stubs = {
        "rclpy": of(),
        "rclpy.exceptions": of(InvalidParameterTypeException=TypeError),
        "rclpy.executors": of(SingleThreadedExecutor=executor),
        "rclpy.qos": of(
            DurabilityPolicy=of(TRANSIENT_LOCAL=1), QoSProfile=lambda **_: None, qos_profile_sensor_data=None
        ),
        "sensor_msgs.msg": of(CameraInfo=None, CompressedImage=None, Image=None),
        "nav_msgs.msg": of(Odometry=None),
    }
    for name, stub in stubs.items():
        monkeypatch.setitem(sys.modules, name, stub)
    monkeypatch.setattr(ros, "message_of_tf", lambda: object)
    opened = []

    def subscribe(*words: str):
        given, callbacks, into = dict(word.split(":=") for word in words), {}, Newest()
        node = of(
            declare_parameter=lambda name, default: of(value=given.get(name, default)),
            resolve_topic_name=lambda name: name,
            create_subscription=lambda kind, topic, callback, quality: callbacks.update({topic: callback}),
            destroy_node=lambda: None,
        )
        monkeypatch.setattr(ros, "new_node", lambda name, words: (None, node))
        ros.subscribe(words, into, needs_camera=False)
        opened.append(into)
        return callbacks, into

    yield subscribe
    for into in opened:
        into.close()


def an_image(time_s: float, frame: str = "camera"):
    image = message(RGB, "rgb8")
    stamp = SimpleNamespace(sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
    image.header = SimpleNamespace(frame_id=frame, stamp=stamp)
    return image


def bent_transforms(length: float):
    """One transform of a gripper whose quaternion has this length."""
    found = transforms([("base", "gripper", at(0.0))])
    found.transforms[0].transform.rotation.w = length
    return found


@pytest.mark.parametrize("length", [0.0, 1.02])
def test_a_transform_that_is_not_rigid_is_left_out_and_said_and_the_images_go_on(topics, length):
    """Symptom: one on /tf, of any frame, ended the camera without a word."""
    callbacks, into = topics("odom_frame:=odom")
    for topic in ("/tf", "/tf_static"):
        into.problem = None
        callbacks[topic](bent_transforms(length))
        assert into.problem == "the transform from base to gripper is left out: its quaternion has not length 1"
    mixed = transforms([("odom", "camera", at(3.0))], 1.0)
    mixed.transforms.insert(0, bent_transforms(length).transforms[0])
    callbacks["image"](an_image(1.0)), callbacks["/tf"](mixed)
    np.testing.assert_array_equal(into.take(1.0).given["T_world_camera"], at(3.0))
    for number in range(40):
        callbacks["image"](an_image(2.0 + 0.1 * number))
    assert "images had no pose of their time; the transform from base to gripper is left out" in into.problem


def test_transforms_that_are_dated_ahead_do_not_begin_anew_and_a_bag_that_is_played_again_does(topics):
    """Symptom: each pose from map to odom, good for seconds to come, and the next of odometry cleared all images."""
    callbacks, into = topics("odom_frame:=map")
    for _ in range(2):
        found = []
        for number in range(60):
            time_s = 10.0 + 0.1 * number
            callbacks["/tf"](transforms([("map", "odom", at(1.0))], time_s + 1.5))
            if number > 20:  # the first transforms that are dated ahead have come to pass
                callbacks["image"](an_image(time_s - 0.05))
            callbacks["/tf"](transforms([("odom", "camera", at(number))], time_s))
            if (shot := into.take(0.0)) is not None:
                found.append((shot.time, shot.given["T_world_camera"][0, 3]))
        assert [x for _, x in found] == pytest.approx([number + 0.5 for number in range(21, 60)])


@pytest.mark.parametrize(("error", "words"), [(ValueError("a bad message"), "a bad message"), (OSError(), "OSError")])
def test_a_callback_that_fails_ends_the_images_with_its_reason(error, words):
    """Symptom: the thread ended, and a run of a camera waited for images in vain."""
    is_destroyed, into = [], Newest()

    def spin_once(timeout_sec):
        raise error

    node = SimpleNamespace(destroy_node=lambda: is_destroyed.append(True))
    ros._spin(SimpleNamespace(spin_once=spin_once), node, into)
    assert into.reason == f"camera ros has failed: {words}" and is_destroyed


def test_compressed_depths_are_metres():
    """As compressed_depth_image_transport writes them; of floats the inverse depth is quantized."""
    raw, header = np.array([[0, 1500], [65535, 2]], np.uint16), bytes(12)
    png = header + cv2.imencode(".png", raw)[1].tobytes()
    found = depth_of(SimpleNamespace(format="16UC1; compressedDepth png", data=png))
    np.testing.assert_allclose(found, raw / 1000, rtol=1e-6)
    depth, most, quantization = np.array([[0.5, 2.0], [9.0, np.nan]]), 10.0, 100.0 * 101.0
    offset = 1.0 - quantization / most
    codes = np.where(np.isfinite(depth), np.round(quantization / depth + offset), 0).astype(np.uint16)
    header = np.int32(0).tobytes() + np.float32([quantization, offset]).tobytes()
    png = header + cv2.imencode(".png", codes)[1].tobytes()
    found = depth_of(SimpleNamespace(format="32FC1; compressedDepth png", data=png))
    np.testing.assert_allclose(found, [[0.5, 2.0], [9.0, 0.0]], rtol=0.01)
    for name, data in (("16UC1; compressedDepth rvl", header + bytes(40)), ("16UC1; compressedDepth png", png[:-5])):
        with pytest.raises(BadFrameError, match="the topic depth has the format '16UC1; compressedDepth"):
            depth_of(SimpleNamespace(format=name, data=data))
