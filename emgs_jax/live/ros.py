"""Images of ROS 2 topics, with their depth and the odometry of the camera, as a source of `Camera`.

`rclpy` is the robot's own where there is one, else that of the extra `ros`. Topics are named `image`, `camera_info`,
`depth` and `odometry`, and remapped as in ROS: `image:=/camera/color/image_raw`.
"""

import contextlib
import threading
import time
from collections.abc import Sequence
from functools import partial
from queue import Queue
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.reading import rigid
from emgs_jax.data.rosbag import calibration_of, to_rgb
from emgs_jax.data.tones import ALL_16_BITS
from emgs_jax.io.packages import extra
from emgs_jax.live.joined_messages import Joined
from emgs_jax.live.newest import Newest, Shot

INFO_S = 30.0  # longest wait for the camera_info
TOPICS = ("image", "camera_info", "depth", "odometry")
PUBLISHED = ("map", "map_update", "path", "pose", "diagnostics", "save")  # by `viewer.ros`
BAYER = {"bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB}
BAYER |= {"bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB}
MILLIMETRE = 1e-3


def new_node(name: str, words: Sequence[str]) -> tuple[ModuleType, Any]:
    """Return rclpy and a node of it with remappings like `image:=/camera/image_raw` or `__ns:=/robot`.

    Raises:
        ValueError: rclpy is not installed, or a word is no remapping.
    """
    rclpy = extra("rclpy", "ROS 2 needs rclpy, the robot's own (source its setup.bash) or", "ros")
    for word in words:
        what, is_remapping, topic = word.partition(":=")
        if not is_remapping or what not in (*TOPICS, *PUBLISHED, "__ns") or not topic:
            known = ", ".join((*TOPICS, *PUBLISHED, "__ns"))
            raise ValueError(f"{word} is no remapping NAME:=TOPIC of one of {known}")
    if not rclpy.ok():
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(args=["emgs"], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the command's
    remapped = [part for word in words for part in ("-r", word)]
    return rclpy, rclpy.create_node(name, cli_args=["--ros-args", *remapped] if remapped else [])


def subscribe(words: Sequence[str], into: Newest, needs_camera: bool) -> Calibration | None:
    """Offer the images of the topics to `into`, from a thread; return their camera if it is needed.

    Raises:
        ValueError: it is needed, and no CameraInfo comes.
    """
    _, node = new_node("emgs", words)
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    topics = dict(word.split(":=") for word in words)
    kinds = {kind for kind, name in (("depth", "depth"), ("pose", "odometry")) if name in topics}
    joined, frames, infos = Joined(kinds), Frames(), Queue()

    def add(kind: str, message: Any) -> None:
        num_alone = joined.num_alone
        try:
            value = frames.read(kind, message)
        except (BadFrameError, ValueError) as error:
            into.problem = str(error)
            return
        for time_s, found in joined.add(kind, stamp_of(message), value):
            given = {name: found[kind] for kind, name in GIVEN.items() if kind in found}
            into.problem = None
            into.put(Shot(time_s, found["image"], given or None))
        if joined.num_alone > num_alone:
            into.problem = f"{joined.num_alone} images had no {' or '.join(sorted(kinds))} of their time"

    image_type = CompressedImage if topics.get("image", "").endswith("compressed") else Image
    quality, info_topic = qos_profile_sensor_data, node.resolve_topic_name("camera_info")
    node.create_subscription(image_type, "image", partial(add, "image"), quality)
    if needs_camera:
        node.create_subscription(CameraInfo, "camera_info", infos.put, quality)
    if "depth" in kinds:
        node.create_subscription(Image, "depth", partial(add, "depth"), quality)
    if "pose" in kinds:
        from nav_msgs.msg import Odometry

        node.create_subscription(Odometry, "odometry", partial(add, "pose"), quality)
        with contextlib.suppress(ImportError):  # not among the wheels of the extra
            from tf2_msgs.msg import TFMessage

            kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            node.create_subscription(TFMessage, "/tf_static", frames.learn, kept)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=_spin, args=(executor, node, into), name="ros", daemon=True).start()
    if not needs_camera:
        return None
    end = time.monotonic() + INFO_S
    while infos.empty() and into.reason is None and time.monotonic() < end:
        time.sleep(0.05)
    if infos.empty():
        into.end("ended before a camera_info came")
        raise ValueError(
            f"no CameraInfo comes on {info_topic} in {INFO_S:g} s: remap it (camera_info:=…), give dataset.intrinsics"
        )
    return calibration_of(infos.get(), topics.get("image", "image"), "ROS")


def _spin(executor: Any, node: Any, into: Newest) -> None:
    """Serve the node's callbacks until no more images are wanted."""
    with contextlib.suppress(Exception):  # ROS is shut down
        while into.reason is None:
            executor.spin_once(timeout_sec=0.1)
        node.destroy_node()


def stamp_of(message: Any) -> float:
    """Seconds of a message's header."""
    return message.header.stamp.sec + message.header.stamp.nanosec / 1e9


def image_of(message: Any) -> np.ndarray:
    """RGB image, uint8 (h, w, 3), of an Image or a CompressedImage; BadFrameError if it is damaged or unknown."""
    encoding = getattr(message, "encoding", None)
    if encoding in BAYER:
        raw = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, : message.width]
        return cv2.cvtColor(raw, BAYER[encoding])
    return ALL_16_BITS.shown(to_rgb(message, encoding is None, "the topic image"))


def depth_of(message: Any) -> np.ndarray:
    """Depth in metres, float32 (h, w), 0 = none, of an Image in 16UC1 (millimetres) or 32FC1 (metres)."""
    kinds = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
    if message.encoding not in kinds:
        raise BadFrameError(f"the topic depth has the encoding {message.encoding!r}, and read are {', '.join(kinds)}")
    dtype = np.dtype(kinds[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, : message.width * dtype.itemsize]
    raw = np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width)
    depth = raw.astype(np.float32) * (MILLIMETRE if dtype.kind == "u" else 1.0)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)


def pose_of(message: Any) -> np.ndarray:
    """T_odom_child (4, 4) of an Odometry."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


class Frames:
    """The frames of a robot: what `odometry` moves, and where the camera stands on it."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, np.ndarray]] = {}  # of a frame, with T_parent_frame
        self._camera = ""

    def learn(self, message: Any) -> None:
        """Take the transforms of a TFMessage on /tf_static."""
        for one in message.transforms:
            place, turn = one.transform.translation, one.transform.rotation
            pose = rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
            self._parents[one.child_frame_id.lstrip("/")] = one.header.frame_id.lstrip("/"), pose

    def read(self, kind: str, message: Any) -> np.ndarray:
        """Read a message of a kind in `READERS`; poses become those of the camera.

        Raises:
            ValueError: the odometry is of another frame than the images, and none of /tf_static joins the two.
        """
        value = READERS[kind](message)
        if kind == "image":
            self._camera = message.header.frame_id.lstrip("/")
        if kind != "pose" or (self._camera and message.child_frame_id.lstrip("/") == self._camera):
            return value
        if not self._camera:
            raise ValueError("no image has come whose header names a frame, so what odometry moves is not known")
        (camera_root, T_root_camera), (moved_root, T_root_moved) = (
            self._above(name) for name in (self._camera, message.child_frame_id.lstrip("/"))
        )
        if camera_root != moved_root:
            raise ValueError(
                f"odometry is of the frame {message.child_frame_id}, images are of {self._camera}, and /tf_static does "
                "not join them: take the odometry of the camera, or publish where it is mounted"
            )
        return value @ np.linalg.inv(T_root_moved) @ T_root_camera

    def _above(self, name: str) -> tuple[str, np.ndarray]:
        """The last frame above one, and the pose of the latter in it."""
        pose = np.eye(4)
        for _ in range(len(self._parents)):
            if name not in self._parents:
                break
            name, step = self._parents[name]
            pose = step @ pose
        return name, pose


READERS = {"image": image_of, "depth": depth_of, "pose": pose_of}
GIVEN = {"depth": "depth", "pose": "T_world_camera"}
