"""A bag of an RGB-D camera with odometry, of a TUM folder: `write`; and its player, `python ros_bag.py BAG`."""

import itertools
import sys
import time
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

STORE, TYPES = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_HUMBLE).types
COLOR, INFO, DEPTH, ODOMETRY = "color/image", "color/info", "depth", "odom"
KINDS = {COLOR: "sensor_msgs/msg/Image", INFO: "sensor_msgs/msg/CameraInfo", DEPTH: "sensor_msgs/msg/Image"}
KINDS |= {ODOMETRY: "nav_msgs/msg/Odometry"}
FPS = 30


def write(path: Path, frames, intrinsics, num_laps: int) -> None:
    """Write frames (RGB, depth in metres, T_odom_camera) as a camera sees them that goes to and fro `num_laps` times.

    It ends a frame beside where it begins, so that it can be played over and over.
    """
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)] * num_laps
    with Writer(path, version=9) as bag:
        topics = {name: bag.add_connection(f"/robot/{name}", kind, typestore=STORE) for name, kind in KINDS.items()}
        for number, row in enumerate(order):
            taken = 10**9 + number * 10**9 // FPS
            for name, message in messages(*frames[row], intrinsics, taken):
                bag.write(topics[name], taken, STORE.serialize_cdr(message, KINDS[name]))


def messages(image, depth, T_odom_camera, intrinsics, taken):
    """(topic, message) of one moment, the image last."""
    header = stamped("camera", taken)
    fx, fy, cx, cy = intrinsics
    K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    P = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
    size, roi = (image.shape[0], image.shape[1]), TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = TYPES[KINDS[INFO]](header, *size, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), P, 0, 0, roi)
    yield INFO, info
    yield ODOMETRY, odometry(T_odom_camera, taken)
    millimetres = np.rint(1000 * depth).astype(np.uint16)
    yield DEPTH, TYPES[KINDS[DEPTH]](header, *size, "16UC1", 0, 2 * size[1], millimetres.view(np.uint8).ravel())
    yield COLOR, TYPES[KINDS[COLOR]](header, *size, "rgb8", 0, 3 * size[1], image.ravel())


def stamped(frame, nanoseconds):
    time_of = TYPES["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
    return TYPES["std_msgs/msg/Header"](stamp=time_of, frame_id=frame)


def odometry(T, taken):
    from scipy.spatial.transform import Rotation

    point = TYPES["geometry_msgs/msg/Point"](*T[:3, 3])
    turn = TYPES["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(T[:3, :3]).as_quat())
    pose = TYPES["geometry_msgs/msg/PoseWithCovariance"](TYPES["geometry_msgs/msg/Pose"](point, turn), np.zeros(36))
    vector = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        TYPES["geometry_msgs/msg/Twist"](vector, vector), np.zeros(36)
    )
    return TYPES[KINDS[ODOMETRY]](stamped("odom", taken), "camera", pose, twist)


def tum_frames(folder: Path, depth_of):
    """Images, depths and true poses of a TUM folder whose times agree.

    Args:
        depth_of: metres of the depth of an image, by its name without the ending.
    """
    from emgs_jax.io.trajectory import load_trajectory_tum

    times, poses = load_trajectory_tum(folder / "groundtruth.txt")
    found = []
    for line in (folder / "rgb.txt").read_text().splitlines():
        if line.startswith("#"):
            continue
        taken, name = line.split()
        image = cv2.imread(str(folder / name))[..., ::-1]
        found.append(
            (np.ascontiguousarray(image), depth_of(taken), poses[int(np.argmin(np.abs(times - float(taken))))])
        )
    return found


def play(path: Path) -> None:
    """Publish a bag in real time, over and over, as a camera that sees it now; print how many images were sent."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.serialization import deserialize_message

    rclpy.init()
    node, publishers, num_sent = rclpy.create_node("bag_player"), {}, 0
    with AnyReader([path], default_typestore=STORE) as bag:
        for connection in bag.connections:
            package, _, name = connection.msgtype.split("/")
            kind = getattr(import_module(f"{package}.msg"), name)
            publishers[connection.topic] = kind, node.create_publisher(kind, connection.topic, qos_profile_sensor_data)
        length = bag.duration + 10**9 // FPS
        begin = time.time_ns()
        for lap in itertools.count():
            for connection, at, raw in bag.messages():
                kind, publisher = publishers[connection.topic]
                message, now = deserialize_message(raw, kind), begin + lap * length + at - bag.start_time
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
                time.sleep(max((now - time.time_ns()) / 1e9, 0.0))
                publisher.publish(message)
                num_sent += connection.topic.endswith(COLOR)
                if connection.topic.endswith(COLOR):
                    print(num_sent, flush=True)


if __name__ == "__main__":
    play(Path(sys.argv[1]))
