"""Bags of ROS 1 and 2 with three images and a camera, written by rosbags' own writers."""

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from tests.data.written_scene import color_image

SIZE = (160, 120)
TAKEN = (10**9, 1_100_000_000, 1_200_000_000)  # nanoseconds
K = [130.0, 0, 80.5, 0, 128.0, 59.0, 0, 0, 1]
P = [110.0, 0, 79.0, 0, 0, 112.0, 60.0, 0, 0, 0, 1, 0]  # of rectified images
D = [0.02, -0.004, 0.001, -0.002, 0.0]


def messages(
    store,
    version,
    kind,
    info=True,
    encoding="bgr8",
    model="plumb_bob",
    bent=D,
    P=P,
    name="raw",
    late=(0, 0, 0),
    num_cut=0,
):
    """(topic, type, message, nanoseconds of its arrival) of three images and a camera_info.

    Args:
        late: nanoseconds by image.
        num_cut: bytes that the second image lacks at its end.
    """
    types = store.types
    extra = {"seq": 0} if version == 1 else {}

    def stamped(nanoseconds):
        time = types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        return types["std_msgs/msg/Header"](stamp=time, frame_id="cam", **extra)

    header = stamped(10**9)
    if info:
        letters = dict(zip("dkrp" if version == 2 else "DKRP", (bent, K, np.eye(3).ravel(), P), strict=True))
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {name: np.array(value, np.float64) for name, value in letters.items()}
        info_type = types["sensor_msgs/msg/CameraInfo"]
        found = info_type(header, SIZE[1], SIZE[0], model, **values, binning_x=0, binning_y=0, roi=roi)
        yield "/cam/camera_info", "sensor_msgs/msg/CameraInfo", found, 5
    for i in range(3):
        image, arrival = color_image(i, SIZE), TAKEN[i] + late[i]
        header = stamped(TAKEN[i])
        if kind == "Image":
            rows = pixels(image, encoding)
            padded = np.pad(rows, ((0, 0), (0, 4)))  # rows may be longer than the picture
            is_big = int(encoding == "mono16")
            data = padded.ravel()[: padded.size - num_cut * (i == 1)]
            found = types["sensor_msgs/msg/Image"](header, *SIZE[::-1], encoding, is_big, padded.shape[1], data)
            yield f"/cam/image_{name}", "sensor_msgs/msg/Image", found, arrival
        else:
            data = cv2.imencode(".png", image)[1].ravel()
            data = data[: data.size - num_cut * (i == 1)]
            found = types["sensor_msgs/msg/CompressedImage"](header, "png", data)
            yield f"/cam/image_{name}/compressed", "sensor_msgs/msg/CompressedImage", found, arrival


def pixels(image, encoding):
    """The bytes of a BGR image (h, b); of mono16 its green in 12 bits, big-endian."""
    if encoding == "mono16":
        return (image[..., 1].astype(np.uint16) * 16).astype(">u2").view(np.uint8)
    return (image[..., 1] if encoding.endswith("C1") else image).reshape(len(image), -1)


def write_bag(folder, version=2, kind="Image", others=(), **options):
    """A bag with the `messages` of these options, and without a camera of each of `others`."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    path = folder / ("walk.bag" if version == 1 else "walk")
    topics = {}
    with Writer1(path) if version == 1 else Writer2(path, version=9) as bag:
        more = [one for other in others for one in messages(store, version, kind, info=False, **other)]
        for topic, msgtype, message, time in [*messages(store, version, kind, **options), *more]:
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, msgtype, typestore=store)
            encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
            bag.write(topics[topic], time, encode(message, msgtype))
    return path


def write_imu(folder, version, table, topics=("/imu",), delay=0):
    """A bag of what inertial measurement units measured: rows of nanoseconds, three rates, three accelerations.

    Args:
        delay: nanoseconds from measurement to arrival.
    """
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    path = folder / ("imu.bag" if version == 1 else "imu")
    kind, types, extra = "sensor_msgs/msg/Imu", store.types, {"seq": 0} if version == 1 else {}
    encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
    turn, unknown = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9)
    with Writer1(path) if version == 1 else Writer2(path, version=9) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, kind, typestore=store)
            for taken, *values in table:
                time = types["builtin_interfaces/msg/Time"](*divmod(int(taken), 10**9))
                header = types["std_msgs/msg/Header"](stamp=time, frame_id="imu", **extra)
                rates, forces = (types["geometry_msgs/msg/Vector3"](*values[k : k + 3]) for k in (0, 3))
                message = types[kind](header, turn, unknown, rates, unknown, forces, unknown)
                bag.write(connection, int(taken) + delay, encode(message, kind))
    return path
