"""Publish a run to ROS 2 while it maps: the map as PointCloud2, the path, the pose and diagnostics.

The frame `map` is that of the odometry at the first image; without odometry it is the first camera. The node runs in
the thread of the run, between two frames, so that it never reads a map that is being changed.
"""

import contextlib
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from emgs_jax.data.base import Rates
from emgs_jax.drawing.colors import to_bytes
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.io.npz import read_npz
from emgs_jax.live.newest import end_all
from emgs_jax.live.ros import message_of_tf, new_node, parameter
from emgs_jax.live.transforms import bare
from emgs_jax.mapping.records import UNPLACED, FrameRecord
from emgs_jax.mapping.run import MappingRun
from emgs_jax.ops.ranges import number

TF_AHEAD_S = 1.0  # by which map → odom is dated ahead, so that it is there when it is asked for, as AMCL does
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
ROW = np.dtype([("point", POINT), ("is_shown", bool)])


Save = Callable[[MappingRun, bool], Path]


@dataclass(frozen=True)
class RosConfig:
    """Settings of `view=ros`."""

    every_s: float = number(1.0, low=0.1, high=3600)  # least seconds between two whole maps


class NewMapError(Exception):
    """A new map shall begin: the service `reset` was called."""


class RosView:
    """A node that publishes a run; `show` is called after each frame.

    Topics: `map` (PointCloud2: all Gaussians; who subscribes later gets the last one), `map_update` (those that the
    last frame changed), `path`, `pose` (Odometry), `diagnostics`, and `map` → the odometry's frame on /tf where the
    package tf2_msgs is installed and `publish_tf` is not false. The services `save` and `reset` (Trigger) save the run
    so far; after the latter `show` raises NewMapError.

    Args:
        save: writes a run and returns its folder; the flag says that this run ends.
    """

    def __init__(self, config: RosConfig, words: Sequence[str], save: Save, has_saved_map: bool = False) -> None:
        self._every_s, self._save_run = config.every_s, save
        self._rclpy, self._node = new_node("emgs_map", words)
        self._types = _types()
        make, kinds = self._node.create_publisher, self._types
        self._map = make(kinds.PointCloud2, "map", _latched())
        self._update = make(kinds.PointCloud2, "map_update", 10)
        self._path, self._pose = make(kinds.Path, "path", _latched()), make(kinds.Odometry, "pose", 10)
        self._diagnostics = make(kinds.DiagnosticArray, "diagnostics", 10)
        self._frame, tf_type = parameter(self._node, "map_frame"), message_of_tf()
        self._camera_frame = parameter(self._node, "camera_frame") or "camera"
        publishes_tf = parameter(self._node, "publish_tf") and tf_type is not None
        self._tf_type, self._tf = tf_type, make(tf_type, "/tf", 10) if publishes_tf else None
        self._node.create_service(kinds.Trigger, "save", self._save)
        self._node.create_service(kinds.Trigger, "reset", self._reset)
        self._is_reset = False
        self._odometry_frame: str | None = bare(parameter(self._node, "odom_frame")) or None
        if any(word.startswith("odometry:=") for word in words):
            self._heard = self._node.create_subscription(kinds.Odometry, "odometry", self._learn, _of_sensors())
        self._run: MappingRun | None = None
        self._due, self._shown = 0.0, None
        self._sent: dict[int, tuple[FrameRecord, Any]] = {}  # poses of the path
        self._T_map_world = np.eye(4) if has_saved_map else None
        self._rates: Rates | None = None

    def show(self, run: MappingRun, image: np.ndarray, rates: Rates | None = None) -> None:
        """Publish a run after its last frame, and answer what was asked.

        Raises:
            NewMapError: a new map shall begin.
        """
        self._run, self._rates = run, rates
        if self._T_map_world is None:
            first = odometry_of(run.records[0])
            self._T_map_world = np.eye(4) if first is None else first
        self._publish(run, run.records[-1])
        self._rclpy.spin_once(self._node, timeout_sec=0.0)
        if self._is_reset:
            end_all()
            raise NewMapError

    def show_last(self, run: MappingRun) -> None:
        """Publish the finished run, whole."""
        self._run, self._due = run, 0.0
        self._publish(run, run.records[-1])

    def stop(self) -> None:
        """End the node."""
        self._node.destroy_node()

    def _learn(self, message: Any) -> None:
        """Learn the odometry's frame from its first message."""
        self._odometry_frame = message.header.frame_id
        self._node.destroy_subscription(self._heard)

    def _publish(self, run: MappingRun, record: FrameRecord) -> None:
        time_s, T = record.timestamp or 0.0, self._T_map_world
        if run.map is not None:
            rows = cloud_of(run.map, T)
            self._update.publish(self._cloud(changed_rows(rows, self._shown), time_s))
            self._shown = rows
            if time.monotonic() >= self._due:
                self._map.publish(self._cloud(rows[rows["is_shown"]], time_s))
                self._path.publish(self._types.Path(header=self._header(time_s), poses=self._placed(run)))
                self._due = time.monotonic() + self._every_s
        if record.status not in UNPLACED:
            pose = self._types.Odometry(header=self._header(time_s), child_frame_id=self._camera_frame)
            pose.pose.pose = self._as_pose(T @ record.pose)
            self._pose.publish(pose)
            odometry = odometry_of(record) if self._tf is not None and self._odometry_frame else None
            if odometry is not None:
                drift = self._transform(T @ record.pose @ np.linalg.inv(odometry), time_s + TF_AHEAD_S)
                self._tf.publish(self._tf_type(transforms=[drift]))
        self._diagnostics.publish(self._status(run, record, time_s))

    def _status(self, run: MappingRun, record: FrameRecord, time_s: float) -> Any:
        """How the last frame went, and how many went so."""
        kinds = self._types
        lost = sum(one.status in UNPLACED for one in run.records)
        values = {"status": record.status, "reason": record.reason or "", "gaussians": record.num_gaussians or 0}
        values |= {"frames": len(run.records), "lost": lost, "seconds": f"{record.seconds:.3f}"}
        if self._rates is not None:
            of_camera = self._rates
            values |= {"maps_per_second": f"{of_camera.maps_per_second:.2f}", "dropped": of_camera.num_dropped}
            values |= {"behind_seconds": f"{of_camera.behind_s:.3f}"}
        level = kinds.DiagnosticStatus.WARN if record.status in UNPLACED else kinds.DiagnosticStatus.OK
        said = [kinds.KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = kinds.DiagnosticStatus(level=level, name="emgs", message=record.status, values=said)
        return kinds.DiagnosticArray(header=self._header(time_s), status=[status])

    def _save(self, request: Any, response: Any) -> Any:
        """Write what is mapped so far."""
        return self._answer(response, is_last=False)

    def _reset(self, request: Any, response: Any) -> Any:
        """Write what is mapped so far, and begin a new map."""
        response = self._answer(response, is_last=True)
        self._is_reset = response.success
        return response

    def _answer(self, response: Any, is_last: bool) -> Any:
        try:
            if self._run is None:
                raise ValueError("nothing is mapped yet")
            response.success, response.message = True, f"written to {self._save_run(self._run, is_last)}"
        except (OSError, ValueError) as error:
            response.success, response.message = False, str(error)
        return response

    def _header(self, time_s: float) -> Any:
        header = self._types.Header(frame_id=self._frame)
        header.stamp.sec, header.stamp.nanosec = int(time_s), round(time_s % 1 * 1e9) % 10**9
        return header

    def _as_pose(self, T: np.ndarray) -> Any:
        pose, turn = self._types.Pose(), Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
        for name, value in zip("xyz", T[:3, 3], strict=True):
            setattr(pose.position, name, float(value))
        for name, value in zip("xyzw", turn, strict=True):
            setattr(pose.orientation, name, float(value))
        return pose

    def _transform(self, T_map_odom: np.ndarray, time_s: float) -> Any:
        one, pose = self._types.TransformStamped(), self._as_pose(T_map_odom)
        one.header, one.child_frame_id, one.transform.rotation = (
            self._header(time_s),
            self._odometry_frame,
            pose.orientation,
        )
        for name in "xyz":
            setattr(one.transform.translation, name, getattr(pose.position, name))
        return one

    def _placed(self, run: MappingRun) -> list[Any]:
        """The placed frames' poses; those that have not changed are sent as they are."""
        before, self._sent = self._sent, {}
        for record in run.records:
            if record.status not in UNPLACED:
                known, stamped = before.get(record.index, (None, None))
                self._sent[record.index] = record, stamped if known is record else self._stamped(record)
        return [stamped for _, stamped in self._sent.values()]

    def _stamped(self, record: FrameRecord) -> Any:
        header = self._header(record.timestamp or 0.0)
        return self._types.PoseStamped(header=header, pose=self._as_pose(self._T_map_world @ record.pose))

    def _cloud(self, rows: np.ndarray, time_s: float) -> Any:
        """A PointCloud2 of rows of `cloud_of`."""
        kinds, packed = self._types, rows["point"]
        fields = [
            kinds.PointField(name=name, offset=offset, count=1, datatype=kinds.PointField.FLOAT32)
            for offset, name in zip(range(0, 16, 4), POINT.names, strict=True)  # as RViz and PCL expect rgb
        ]
        cloud = kinds.PointCloud2(header=self._header(time_s), height=1, width=len(packed), fields=fields)
        cloud.point_step, cloud.row_step, cloud.is_dense = POINT.itemsize, POINT.itemsize * len(packed), True
        cloud.data = array("B", packed.tobytes())
        return cloud


def cloud_of(map: GaussianMap, T_map_world: np.ndarray) -> np.ndarray:
    """The means and colours of all rows of a map, and which of them are shown: those that are confirmed."""
    rows = np.zeros(map.existence.shape, ROW)
    means = np.asarray(map.gaussians.means) @ T_map_world[:3, :3].T + T_map_world[:3, 3]
    rows["point"]["x"], rows["point"]["y"], rows["point"]["z"] = means.T
    red, green, blue = to_bytes(np.asarray(map.gaussians.colors)).astype(np.uint32).T
    rows["point"]["rgb"] = red << 16 | green << 8 | blue
    rows["is_shown"] = np.asarray(map.gaussians.valid & (map.existence > 0))
    return rows


def changed_rows(rows: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Select the shown rows that were not shown so before; a map that has grown has new rows at its end."""
    if before is None:
        return rows[rows["is_shown"]]
    same = np.zeros(len(rows), bool)
    count = min(len(rows), len(before))
    same[:count] = rows[:count] == before[:count]
    return rows[rows["is_shown"] & ~same]


def odometry_of(record: FrameRecord) -> np.ndarray | None:
    """T_odom_camera (4, 4) that came with a frame's image; None without."""
    beside = None if record.name is None else Path(record.name).with_suffix(".npz")
    if beside is None or not beside.is_file():
        return None
    with beside.open("rb") as handle:
        found = read_npz(handle, (), ("T_world_camera",)).get("T_world_camera")
    return found if found is not None and np.isfinite(found).all() else None


def _of_sensors() -> Any:
    """Quality of topics of sensors."""
    from rclpy.qos import qos_profile_sensor_data

    return qos_profile_sensor_data


def _latched() -> Any:
    """Quality of a topic whose last message late subscribers get, too."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    reliable, kept = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(depth=1, reliability=reliable, durability=kept)


def _types() -> SimpleNamespace:
    """The types of messages, once rclpy is there."""
    import diagnostic_msgs.msg as diagnostics
    import geometry_msgs.msg as geometry
    import nav_msgs.msg as navigation
    import sensor_msgs.msg as sensors
    import std_msgs.msg as standard
    from std_srvs.srv import Trigger

    found = {
        **{name: getattr(diagnostics, name) for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")},
        **{name: getattr(geometry, name) for name in ("Pose", "PoseStamped", "TransformStamped")},
        **{name: getattr(navigation, name) for name in ("Odometry", "Path")},
        **{name: getattr(sensors, name) for name in ("PointCloud2", "PointField")},
    }
    return SimpleNamespace(**found, Header=standard.Header, Trigger=Trigger)


@contextlib.contextmanager
def ros_view(config: RosConfig, words: Sequence[str], save: Save, has_saved_map: bool = False) -> Iterator[RosView]:
    """Publish a run during the block, under the remappings `words`; a saved map is in a frame of its own."""
    view = RosView(config, words, save, has_saved_map)
    try:
        tqdm.write("the map is published to ROS 2: map, map_update, path, pose, diagnostics; services save and reset")
        yield view
    finally:
        view.stop()
