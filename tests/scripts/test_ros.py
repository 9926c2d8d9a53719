"""`emgs ros` with the real rclpy: publisher, node and subscriber are three processes, over shared memory alone."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import own_process
import pytest
from tiny_run import TINY, dataset

from emgs_jax.config import configure
from emgs_jax.live.ros import new_node
from experiments.cli import explained
from experiments.command import check_arguments
from experiments.ros import with_topics

OF_ROOM = [word for word in TINY if not word.startswith("dataset.")]
TOPICS = ("image:=/robot/color/image", "camera_info:=/robot/color/info", "depth:=/robot/depth", "odometry:=/robot/odom")


def test_topics_are_the_source_of_a_camera_and_depth_with_odometry_is_the_prior(monkeypatch, capsys):
    found = with_topics([*TOPICS, "dataset.size=[64,48]"])
    assert found == [f"dataset.source='ros {' '.join(TOPICS)}'", "prior=stream", "dataset.size=[64,48]"]
    check_arguments("ros", found)
    config = configure.compose(*found, name="ros")
    assert config.dataset.source == f"ros {' '.join(TOPICS)}" and config.prior._target_.endswith("Stream")
    assert config.view._target_.endswith("RosConfig")
    assert with_topics(TOPICS[:2]) == [f"dataset.source='ros {' '.join(TOPICS[:2])}'"]
    monkeypatch.setattr(sys, "argv", ["emgs ros", "--help"])
    explained("ros")()
    for example in re.findall(r"^  emgs ros (.*)", capsys.readouterr().out, re.MULTILINE):
        check_arguments("ros", with_topics(example.split()))


def test_a_word_that_is_no_remapping_is_named(monkeypatch):
    monkeypatch.setattr("emgs_jax.live.ros.extra", lambda *words: None)
    with pytest.raises(ValueError, match=r"picture:=/a is no remapping NAME:=TOPIC of one of image, camera_info"):
        new_node("emgs", ["picture:=/a"])


@pytest.fixture
def shared_memory(monkeypatch):
    pytest.importorskip("rclpy", reason="ROS 2: pip install -e .[ros]")
    for name, value in {
        "FASTDDS_BUILTIN_TRANSPORTS": "SHM",  # no network
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_DOMAIN_ID": str(os.getpid() % 100),
    }.items():
        monkeypatch.setenv(name, value)


@pytest.mark.slow
def test_a_robots_camera_is_mapped_while_it_runs_and_its_map_is_heard(tmp_path, shared_memory):
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    for row, frame in enumerate(dataset()):
        cv2.imwrite(str(recorded / f"{row}.png"), frame.image[..., ::-1])
        given = {"depth": frame.depth, "T_world_camera": frame.T_world_camera, "intrinsics": dataset().intrinsics}
        np.savez(recorded / f"{row}.npz", **given)
    publisher = subprocess.Popen([sys.executable, Path(__file__).parents[1] / "ros_publisher.py", recorded, "30"])
    out, said = tmp_path / "run", tmp_path / "said"
    words = *TOPICS, "dataset.size=[64,48]", "dataset.record=true", f"hydra.run.dir={out}", *OF_ROOM
    try:
        process = own_process.begin("experiments.ros", *words, said=said)
        heard = Heard()
        own_process.wait_for(heard.has_enough, process)
        assert process.is_alive(), said.read_text()
        saved = heard.save()
        assert saved.success and (out / "map.npz").is_file() and not (out / "metrics.json").exists()
        os.kill(process.pid, signal.SIGINT)
        assert own_process.ended(process) == 0, said.read_text()
    finally:
        publisher.kill()
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames/lost"] == 0 and metrics["frames/tracked"] > 5 and metrics["camera/num_dropped"] > 0
    # The map lies where the odometry has the room: on its floor (z = 0), and no point is outside of it.
    cloud = heard.points()
    truth = np.concatenate([points_of(frame) for frame in dataset()])
    low, high = truth.min(0) - 0.1, truth.max(0) + 0.1
    assert len(cloud) > 200 and ((cloud >= low) & (cloud <= high)).all(1).mean() > 0.98
    places = np.array([frame.T_world_camera[:3, 3] for frame in dataset()])
    path = np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in heard.path.poses])
    assert np.linalg.norm(path[:, None] - places, axis=2).min(1).max() < 0.03, "each pose is one of the camera's"
    assert heard.last_status() == "tracked" and heard.map.header.frame_id == "map"
    recording = [*(out / "recorded").glob("*.png")]
    assert len(recording) == len([*(out / "recorded").glob("*.npz")]) == metrics["frames/tracked"] + 1


def points_of(frame) -> np.ndarray:
    """What a frame sees, in the world."""
    from emgs_jax.data.backprojection import backproject

    points = backproject(frame.depth, dataset().intrinsics)[frame.depth > 0]
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


class Heard:
    """A subscriber of what the node publishes."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import Path as PathMessage
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import PointCloud2
        from std_srvs.srv import Trigger

        self._rclpy, self._trigger = rclpy, Trigger
        if not rclpy.ok():
            rclpy.init()
        self._node, self.map, self.path, self.updates, self.diagnostics = (
            rclpy.create_node("who_listens"),
            None,
            None,
            0,
            [],
        )
        latched = QoSProfile(
            depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._node.create_subscription(PointCloud2, "map", lambda cloud: setattr(self, "map", cloud), latched)
        self._node.create_subscription(PathMessage, "path", lambda path: setattr(self, "path", path), latched)
        self._node.create_subscription(PointCloud2, "map_update", self._count, 10)
        self._node.create_subscription(DiagnosticArray, "diagnostics", self.diagnostics.append, 10)
        self._save = self._node.create_client(Trigger, "save")

    def _count(self, cloud) -> None:
        self.updates += 1

    def has_enough(self) -> bool:
        self._rclpy.spin_once(self._node, timeout_sec=0.05)
        return self.map is not None and self.path is not None and len(self.path.poses) > 5 and self.updates > 3

    def save(self):
        future, end = self._save.call_async(self._trigger.Request()), time.monotonic() + 60
        while not future.done() and time.monotonic() < end:
            self._rclpy.spin_once(self._node, timeout_sec=0.05)
        return future.result()

    def points(self) -> np.ndarray:
        packed = np.frombuffer(bytes(self.map.data), np.float32).reshape(-1, 4)
        assert len(packed) == self.map.width and [field.name for field in self.map.fields] == ["x", "y", "z", "rgb"]
        return packed[:, :3]

    def last_status(self) -> str:
        return self.diagnostics[-1].status[0].message
