"""Images of ROS 2 topics, with their depth and the odometry of the camera, as a source of `Camera`.

`rclpy` is the robot's own where there is one, else that of the extra `ros`. Topics are named `image`, `camera_info`,
`depth` and `odometry`, and remapped as in ROS: `image:=/camera/color/image_raw`. Parameters of the node are given
likewise: `odom_frame:=odom`.
"""

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from queue import Queue
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.reading import damage, rigid
from emgs_jax.data.rosbag import calibration_of, to_rgb
from emgs_jax.data.tones import ALL_16_BITS
from emgs_jax.io.packages import extra
from emgs_jax.live.joined_messages import Joined
from emgs_jax.live.newest import Newest, Shot
from emgs_jax.live.transforms import Transforms, bare, stamp_of

INFO_S = 30.0  # longest wait for the camera_info
TOPICS = ("image", "camera_info", "depth", "odometry")
PUBLISHED = ("map", "map_update", "path", "pose", "diagnostics", "save", "reset")  # by `viewer.ros`
PARAMETERS = {"odom_frame": "", "camera_frame": "", "map_frame": "map", "publish_tf": True}  # defaults of the nodes
BAYER = {"bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB}
BAYER |= {"bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB}
MILLIMETRE = 1e-3
COMPRESSED_HEADER = 12  # bytes of compressed_depth_image_transport: a format, and two numbers of its quantization


def new_node(name: str, words: Sequence[str]) -> tuple[ModuleType, Any]:
    """Return rclpy and a node of it with remappings like `image:=/camera/image_raw` or `__ns:=/robot`, and parameters.

    Raises:
        ValueError: rclpy is not installed, or a word is neither.
    """
    rclpy = extra("rclpy", "ROS 2 needs rclpy, the robot's own (source its setup.bash) or", "ros")
    for word in words:
        what, is_remapping, topic = word.partition(":=")
        if not is_remapping or what not in (*TOPICS, *PUBLISHED, "__ns", *PARAMETERS) or not topic:
            known, parameters = ", ".join((*TOPICS, *PUBLISHED, "__ns")), ", ".join(PARAMETERS)
            raise ValueError(f"{word} is no remapping NAME:=TOPIC of one of {known}, nor one of {parameters}")
    if not rclpy.ok():
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(args=["emgs"], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the command's
    given = [part for word in words for part in ("-p" if word.partition(":=")[0] in PARAMETERS else "-r", word)]
    return rclpy, rclpy.create_node(name, cli_args=["--ros-args", *given] if given else [])


def parameter(node: Any, name: str) -> Any:
    """Return a parameter of a node; ValueError if what was given for it is of another type than its default."""
    from rclpy.exceptions import InvalidParameterTypeException

    try:
        return node.declare_parameter(name, PARAMETERS[name]).value
    except InvalidParameterTypeException as error:
        kind = {str: "a name", bool: "true or false"}[type(PARAMETERS[name])]
        raise ValueError(f"{name}:= must be {kind}") from error


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
    odom_frame = bare(parameter(node, "odom_frame"))
    frames, infos, find = Frames(parameter(node, "camera_frame")), Queue(), {}
    if odom_frame and "odometry" in topics:
        raise ValueError(
            f"odometry:={topics['odometry']} and odom_frame:={odom_frame} are two sources of poses, a topic and /tf: "
            "give one"
        )
    if odom_frame:
        kinds.add("pose")
        find["pose"] = lambda _, time_s: frames.transforms.pose(frames.camera, odom_frame, time_s)
    joined = Joined(kinds, find)

    def add(kind: str, message: Any) -> None:
        num_alone = joined.num_alone
        try:
            value = frames.read_pose(message) if kind == "pose" else message
        except ValueError as error:
            say(str(error))
            return
        if kind == "image":
            frames.see(message)
        put(joined.add(kind, stamp_of(message), value), num_alone)

    def put(whole: Iterator[tuple[float, dict[str, Any]]], num_alone: int) -> None:
        for time_s, found in whole:
            into.put(partial(shot_of, time_s, found))
        if joined.num_alone > num_alone:
            is_apart = odom_frame and not frames.transforms.way(frames.camera, odom_frame)
            say(
                f"/tf does not lead from {odom_frame} to {frames.camera or 'a frame in the images'}"
                if is_apart
                else f"{joined.num_alone} images had no {' or '.join(sorted(kinds))} of their time"
            )

    def say(problem: str | None = None) -> None:
        """Keep what is wrong with the images, and with the transforms that they need."""
        into.problem = "; ".join(filter(None, (problem, frames.transforms.problem))) or into.problem

    def add_fixed(message: Any) -> None:
        frames.transforms.add_fixed(message)
        say()

    def add_moving(message: Any) -> None:
        if frames.transforms.add_moving(message, frames.camera, odom_frame):
            put(joined.whole(), joined.num_alone)
        say()

    image_type = CompressedImage if topics.get("image", "").endswith("compressed") else Image
    quality, info_topic = qos_profile_sensor_data, node.resolve_topic_name("camera_info")
    node.create_subscription(image_type, "image", partial(add, "image"), quality)
    if needs_camera:
        node.create_subscription(CameraInfo, "camera_info", infos.put, quality)
    if "depth" in kinds:
        depth_type = CompressedImage if topics["depth"].endswith("compressedDepth") else Image
        node.create_subscription(depth_type, "depth", partial(add, "depth"), quality)
    if "odometry" in topics:
        from nav_msgs.msg import Odometry

        node.create_subscription(Odometry, "odometry", partial(add, "pose"), quality)
    if "pose" in kinds:
        tf_type = message_of_tf()
        if tf_type is None and odom_frame:
            raise ValueError(f"odom_frame:={odom_frame} takes poses from /tf, which needs the package tf2_msgs")
        if tf_type is not None:
            kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            node.create_subscription(tf_type, "/tf_static", add_fixed, kept)
        if odom_frame:
            node.create_subscription(tf_type, "/tf", add_moving, QoSProfile(depth=100))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    into.fill(partial(_spin, executor, node, into), "ros")
    if not needs_camera:
        return None
    end = time.monotonic() + INFO_S
    while infos.empty() and into.reason is None and time.monotonic() < end:
        time.sleep(0.05)
    if infos.empty():
        into.end(
            f"no CameraInfo comes on {info_topic} in {INFO_S:g} s: remap it (camera_info:=…), give dataset.intrinsics"
        )
        raise ValueError(into.reason)
    return calibration_of(infos.get(), topics.get("image", "image"), "ROS")


def _spin(executor: Any, node: Any, into: Newest) -> None:
    """Serve the node's callbacks until no more images are wanted, ROS is shut down, or one of them fails."""
    try:
        while into.reason is None:
            executor.spin_once(timeout_sec=0.1)
    except Exception as error:
        into.end(f"camera ros has failed: {str(error) or type(error).__name__}")
    with contextlib.suppress(Exception):  # ROS is shut down
        node.destroy_node()


def message_of_tf() -> type | None:
    """Return the type of the messages on /tf; None without its package, which the wheels of the extra lack."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage


def image_of(message: Any) -> np.ndarray:
    """RGB image, uint8 (h, w, 3), of an Image or a CompressedImage; BadFrameError if it is damaged or unknown."""
    encoding = getattr(message, "encoding", None)
    if encoding in BAYER:
        raw = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, : message.width]
        return cv2.cvtColor(raw, BAYER[encoding])
    return ALL_16_BITS.shown(to_rgb(message, encoding is None, "the topic image"))


def depth_of(message: Any) -> np.ndarray:
    """Depth in metres, float32 (h, w), 0 = none, of an Image in 16UC1 (millimetres) or 32FC1 (metres).

    BadFrameError for another encoding. A CompressedImage is one of compressed_depth_image_transport.
    """
    if not hasattr(message, "encoding"):
        return compressed_depth_of(message)
    kinds = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
    if message.encoding not in kinds:
        raise BadFrameError(f"the topic depth has the encoding {message.encoding!r}, and read are {', '.join(kinds)}")
    dtype = np.dtype(kinds[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, : message.width * dtype.itemsize]
    raw = np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width)
    return known_depth(raw.astype(np.float32) * (MILLIMETRE if dtype.kind == "u" else 1.0))


def compressed_depth_of(message: Any) -> np.ndarray:
    """Depth in metres, float32 (h, w), 0 = none, of a CompressedImage "16UC1; compressedDepth png", or 32FC1 likewise.

    The latter's PNG holds r = A / depth + B, 0 = none, with A and B in the header.
    """
    kind, data = message.format.partition(";")[0].strip(), bytes(message.data)
    header, png = data[:COMPRESSED_HEADER], data[COMPRESSED_HEADER:]
    raw = None if damage(png) else cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    if kind not in ("16UC1", "32FC1") or raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        raise BadFrameError(
            f"the topic depth has the format {message.format!r}, and read are 16UC1 and 32FC1 as compressedDepth png"
        )
    if kind == "16UC1":
        return raw.astype(np.float32) * np.float32(MILLIMETRE)
    quantization, offset = np.frombuffer(header, "<f4", 2, offset=4)
    with np.errstate(divide="ignore", invalid="ignore"):
        return known_depth(np.where(raw > 0, quantization / (raw - offset), 0.0))


def known_depth(depth: np.ndarray) -> np.ndarray:
    """Depth as float32 with 0 where it is not finite and above 0."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)


def pose_of(message: Any) -> np.ndarray:
    """T_odom_child (4, 4) of an Odometry."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def shot_of(time_s: float, found: Mapping[str, Any]) -> Shot:
    """Decode the messages of an image and its depth; BadFrameError if one is damaged or unknown."""
    try:
        image = image_of(found["image"])
        given = {"depth": depth_of(found["depth"])} if "depth" in found else {}
    except ValueError as error:
        raise BadFrameError(str(error)) from error
    given |= {"T_world_camera": found["pose"]} if "pose" in found else {}
    return Shot(time_s, image, given or None)


class Frames:
    """The frames of a robot: what `odometry` moves, and where the camera stands on it.

    Args:
        camera: frame of the images; empty: as their headers say.
    """

    def __init__(self, camera: str = "") -> None:
        self.transforms, self.camera = Transforms(), bare(camera)
        self._is_given = bool(camera)

    def see(self, message: Any) -> None:
        """Learn the frame of the images from one of them."""
        if not self._is_given:
            self.camera = bare(message.header.frame_id)

    def read_pose(self, message: Any) -> np.ndarray:
        """Pose (4, 4) of the camera, of an Odometry.

        Raises:
            ValueError: the odometry is of another frame than the images, and none of /tf_static joins the two.
        """
        value = pose_of(message)
        if self.camera and bare(message.child_frame_id) == self.camera:
            return value
        if not self.camera:
            raise ValueError(
                "no image has come whose header names a frame, so what odometry moves is not known: give camera_frame:="
            )
        (camera_root, T_root_camera), (moved_root, T_root_moved) = (
            self.transforms.root(name) for name in (self.camera, bare(message.child_frame_id))
        )
        if camera_root != moved_root:
            raise ValueError(
                f"odometry is of the frame {message.child_frame_id}, images are of {self.camera}, and /tf_static does "
                "not join them: take the odometry of the camera, publish where it is mounted, or take poses from /tf "
                "(odom_frame:=odom in place of odometry)"
            )
        return value @ np.linalg.inv(T_root_moved) @ T_root_camera
