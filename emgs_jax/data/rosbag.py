"""Images and inertial measurements of a bag of ROS 1 or 2, read without ROS by the package rosbags."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.camera_models import Calibration, named_lens
from emgs_jax.data.intrinsics import ALTERNATIVES, Given, Pictures, find_lens, to_lens
from emgs_jax.data.straightened import Straightened
from emgs_jax.data.tones import ALL_16_BITS, find_tones

LAYOUT = "root[/sequence] = a .bag of ROS 1, or the folder of a ROS 2 bag with metadata.yaml"
RAW, COMPRESSED, INFO, IMU = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo", "Imu"))
# Channels of an encoding, and OpenCV's conversion to RGB. Programs publish 8UC… when they name no encoding: then it is
# OpenCV's order of colours.
ENCODINGS = {"rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "8UC3": (3, cv2.COLOR_BGR2RGB)}
ENCODINGS |= {"rgba8": (4, cv2.COLOR_RGBA2RGB), "bgra8": (4, cv2.COLOR_BGRA2RGB), "8UC4": (4, cv2.COLOR_BGRA2RGB)}
ENCODINGS |= dict.fromkeys(("mono8", "mono16", "8UC1"), (1, cv2.COLOR_GRAY2RGB))
DEPTHS = re.compile(r"(16|32|64)[USF]C[1-4]$")  # also of compressed depths
RECTIFIED = re.compile(r"(^|[/_])rect([/_]|$)")  # a topic of image_proc and others


@dataclass(eq=False)
class RosBag(Straightened):
    """The images of one topic of the bag root or root/sequence, in the order in which they were taken."""

    topic: str | None = None  # of sensor_msgs/Image or CompressedImage; None: the only one
    info_topic: str | None = None  # of sensor_msgs/CameraInfo; None: camera_info beside the topic, or the only one
    intrinsics: Given | None = None  # as for `Images`; None: those of the first CameraInfo

    name, layout, source = "rosbag", LAYOUT, "ros2 bag record"

    def __post_init__(self) -> None:
        self._path = self._find(self.sequence or ".")
        self._folder = self._path.parent
        with _opened(self._path) as bag:
            self._topic = _topic_of(bag, (RAW, COMPRESSED), self.topic, self._path, "dataset.topic=")
            received, stamps = _times(bag, self._topic)
            info = None if self.intrinsics is not None else _camera_info(bag, self._topic, self.info_topic, self._path)
        first: dict[int, int] = {}  # row of each time, which several messages may share
        places = [(time, row - first.setdefault(time, row)) for row, time in enumerate(received)]
        taken, note = when_taken(received, stamps)
        order = sorted(range(len(taken)), key=lambda row: taken[row])
        chosen = self._select(len(order), f"{self._path}, topic {self._topic},")
        self._places = [places[order[place]] for place in chosen]
        self._taken = [taken[order[place]] for place in chosen]
        self._tones = find_tones(self._picture, len(self))
        raw_size = reading.first_size(range(len(self)), f"{self._path}, topic {self._topic},", read=self._shown)
        if info is None:
            lens = find_lens(self.intrinsics, Pictures(raw_size, len(self), self._shown))
        else:
            lens = to_lens(info, raw_size, f"CameraInfo of {self._path}", {"source": "CameraInfo"})
        self._use(lens, raw_size, note)

    def __len__(self) -> int:
        return len(self._places)

    def _place(self, index: int) -> tuple[float, str]:
        return self._taken[index] / 1e9, f"{self._path}, {self._topic}, image at {self._taken[index]} ns"

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        image = self._shown(index)
        reading.check_raw_size(image, self._raw_size, self._place(index)[1])
        return image

    def files(self, index: int) -> list[Path]:
        return sorted(path for path in self._path.iterdir() if path.is_file()) if self._path.is_dir() else [self._path]

    def _options(self) -> dict[str, Any]:
        return {"topic": self._topic, "lens": self.calibration["distortion"], "frames": self._places}

    def _fingerprinted(self) -> list[Path]:
        return self.files(0)  # the same for all

    def _shown(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        return (self._tones or ALL_16_BITS).shown(self._picture(index))

    def _picture(self, index: int) -> np.ndarray:
        """RGB (h, w, 3) in the message's own bits."""
        time, ordinal = self._places[index]
        with _opened(self._path) as bag:
            found = bag.messages(connections=_connections(bag, self._topic), start=time, stop=time + 1)
            for number, (connection, _, raw) in enumerate(found):
                if number == ordinal:
                    message = bag.deserialize(raw, connection.msgtype)
                    return to_rgb(message, connection.msgtype == COMPRESSED, self._place(index)[1])
        raise BadFrameError(f"{self._place(index)[1]} is not there any more: record the bag again")


def _times(bag: Any, topic: str) -> tuple[list[int], list[int]]:
    """Nanoseconds at which each message of a topic was received, and its header's stamp; 0 = none."""
    received, stamps = [], []
    for connection, time, raw in bag.messages(connections=_connections(bag, topic)):
        received.append(time)
        try:
            stamp = bag.deserialize(raw, connection.msgtype).header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
        except Exception:  # a damaged message, which is a bad frame when it is read
            stamps.append(0)
    return received, stamps


def when_taken(received: Sequence[int], stamps: Sequence[int]) -> tuple[list[int], str | None]:
    """Nanoseconds at which images were taken, by their headers' stamps, as messages overtake each other.

    If no message has a stamp, or all have the same, the times of reception are taken, with a note. A single message
    without one gets the others' median delay.
    """
    known = [row for row, stamp in enumerate(stamps) if stamp > 0]
    if not known or (len(known) > 1 and len({stamps[row] for row in known}) == 1):
        return [*received], "the headers have no times, so images have those of their recording" if received else None
    delay = int(np.median([received[row] - stamps[row] for row in known]))
    return [stamp if stamp > 0 else time - delay for time, stamp in zip(received, stamps, strict=True)], None


def is_bag(path: Path) -> bool:
    """Test whether a path is that of a bag of ROS 1, or of the folder of one of ROS 2."""
    return path.is_dir() or path.suffix == ".bag"


def read_imu(path: Path, topic: str | None) -> Float[np.ndarray, "m 7"]:
    """Read time (s), rates (rad/s) and accelerations (m/s²) of a topic, in the order in which they were measured.

    Args:
        topic: of sensor_msgs/Imu; None: the only one.

    Raises:
        ValueError: there is no such bag or topic.
    """
    rows, received, stamps = [], [], []
    with _opened(path) as bag:
        topic = _topic_of(bag, (IMU,), topic, path, f"scale.imu={path}:TOPIC,")
        for connection, time, raw in bag.messages(connections=_connections(bag, topic)):
            message = bag.deserialize(raw, connection.msgtype)
            stamp, vectors = message.header.stamp, (message.angular_velocity, message.linear_acceleration)
            received.append(time)
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
            rows.append([value for vector in vectors for value in (vector.x, vector.y, vector.z)])
    times, order = np.unique(when_taken(received, stamps)[0], return_index=True)  # a message may be recorded twice
    return np.column_stack([times / 1e9, np.array(rows, np.float64).reshape(-1, 6)[order]])


def to_rgb(message: Any, is_compressed: bool, label: str) -> np.ndarray:
    """The picture of a message, RGB (h, w, 3), 8 or 16 bits; BadFrameError if it is damaged or its encoding unknown."""
    encoding = str(message.format).partition(";")[0].strip() if is_compressed else str(message.encoding)
    is_depth = DEPTHS.match(encoding) is not None or (is_compressed and "compressedDepth" in str(message.format))
    if is_depth or (not is_compressed and encoding not in ENCODINGS):
        what = " (depths)" if is_depth else ""
        raise BadFrameError(
            f"{label} has the encoding {encoding[:40]!r}{what}, and read are {', '.join(ENCODINGS)}: "
            "choose another dataset.topic, such as the rectified one"
        )
    if is_compressed:
        data = bytes(message.data)
        image = None if reading.damage(data) else cv2.imdecode(np.frombuffer(data, np.uint8), reading.OWN_BITS)
        if image is None:
            raise BadFrameError(f"{label} is damaged: record it again, or set on_bad_frame=skip")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    dtype = np.dtype(np.uint16 if encoding == "mono16" else np.uint8)
    dtype = dtype.newbyteorder(">" if message.is_bigendian else "<")
    channels, code = ENCODINGS[encoding]
    width = message.width * channels * dtype.itemsize
    if message.step < width or len(message.data) != message.step * message.height or not message.height * width:
        raise BadFrameError(f"{label} is not as large as it says: record it again, or set on_bad_frame=skip")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, :width]
    image = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    image = image.reshape(message.height, message.width, -1)
    return image if code is None else cv2.cvtColor(image, code)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag; errors become a ValueError that names it."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ValueError('a bag needs the library rosbags: pip install "emgs_jax[rosbag]"') from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except Exception as error:  # the library and SQLite raise many types for a damaged bag
        if isinstance(error, ValueError) and str(path) in str(error):
            raise  # ours
        what = f"{type(error).__name__}: {error}"[:200]
        raise ValueError(f"{path} is no bag that can be read ({what}); expected {LAYOUT}") from error


def _connections(bag: Any, topic: str) -> list[Any]:
    return [connection for connection in bag.connections if connection.topic == topic]


def _topic_of(bag: Any, kinds: Sequence[str], topic: str | None, path: Path, key: str) -> str:
    """The given topic, or the only one of these kinds."""
    there = sorted({connection.topic for connection in bag.connections if connection.msgtype in kinds})
    if topic in there:
        return topic
    if topic is None and len(there) == 1:
        return there[0]
    kind = kinds[0].rsplit("/", 1)[1]
    if not there:
        raise ValueError(f"{path} has no topic of sensor_msgs/{kind}")
    what = f"no topic {topic}" if topic else "several"
    raise ValueError(f"{path} has {what} of sensor_msgs/{kind}: give {key} one of {', '.join(there)}")


def _camera_info(bag: Any, topic: str, info_topic: str | None, path: Path) -> Calibration:
    kinds = {connection.topic for connection in bag.connections if connection.msgtype == INFO}
    beside = f"{topic.removesuffix('/compressed').rsplit('/', 1)[0]}/camera_info"
    if not kinds:
        raise ValueError(f"{path} has no camera_info, so dataset.intrinsics must say the camera: give {ALTERNATIVES}")
    wanted = beside if info_topic is None and beside in kinds else info_topic
    chosen = _connections(bag, _topic_of(bag, (INFO,), wanted, path, "dataset.info_topic="))
    for connection, _, raw in bag.messages(connections=chosen):
        return calibration_of(bag.deserialize(raw, connection.msgtype), topic, str(path))
    raise ValueError(f"{path}: camera_info has no message, so dataset.intrinsics must say the camera: {ALTERNATIVES}")


def calibration_of(message: Any, topic: str, where: str) -> Calibration:
    """The camera of a CameraInfo for the images of `topic`; ValueError if it is not whole."""
    K, bent, P = (getattr(message, name if hasattr(message, name) else name.upper()) for name in "kdp")  # ROS 1: K
    size, bent = (int(message.width), int(message.height)), [float(v) for v in bent]
    if RECTIFIED.search(topic):  # K and D are of the raw image, P of the rectified one
        if not P[0] > 0 or not P[5] > 0:
            raise ValueError(f"{where}: camera_info has no P for the rectified {topic}: give dataset.intrinsics")
        return Calibration((float(P[0]), float(P[5]), float(P[2]), float(P[6])), (), size)
    intrinsics = float(K[0]), float(K[4]), float(K[2]), float(K[5])
    about = f"{where}: camera_info (a rectified topic needs none of its distortion)"
    lens, model = named_lens(message.distortion_model, bent, about)
    return Calibration(intrinsics, lens, size, model)
