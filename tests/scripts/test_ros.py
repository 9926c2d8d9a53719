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
from emgs_jax.runs.finished_run import read_run
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
    publisher = published(tmp_path)
    out, said = tmp_path / "run", tmp_path / "said"
    words = *TOPICS, "dataset.size=[64,48]", "dataset.record=true", f"hydra.run.dir={out}", *OF_ROOM
    try:
        process = own_process.begin("experiments.ros", *words, said=said)
        heard = Heard()
        own_process.wait_for(heard.has_enough, process)
        assert process.is_alive(), said.read_text()
        saved = heard.ask("save")
        assert saved.success and not (out / "metrics.json").exists()
        again = heard.ask("reset")  # the map that is finished below is another one
        assert [answer.message for answer in (saved, again)] == [
            f"written to {out}/saved-{number}" for number in (1, 2)
        ]
        num_updates = heard.updates
        own_process.wait_for(lambda: heard.has_enough() and heard.updates > num_updates + 3, process)
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
    said = [status.values for one in heard.diagnostics for status in one.status][-1]
    facts = {pair.key: pair.value for pair in said}
    assert facts["lost"] == "0" and int(facts["dropped"]) > 0 and float(facts["maps_per_second"]) > 0
    recording = [*(out / "recorded").glob("*.png")]
    assert len(recording) == len([*(out / "recorded").glob("*.npz")]) == metrics["frames/tracked"] + 1
    first, second = (read_run(out / f"saved-{number}") for number in (1, 2))
    assert 5 < len(first.frames) < len(second.frames) and {frame["status"] for frame in second.frames[1:]} == {
        "tracked"
    }
    assert [frame["index"] for frame in second.frames] == [*range(len(second.frames))]
    images = second.provenance["config"]["dataset"]
    assert images["root"] == str(out / "saved-2" / "recorded") and images["stop"] == len(second.frames)
    assert len([*(out / "saved-2" / "recorded").glob("*.png")]) >= len(second.frames)


@pytest.mark.slow
def test_what_was_saved_outlives_the_node_and_the_publisher(tmp_path, shared_memory):
    """The node is killed after it has saved; the publisher is killed before another node, which finishes its map."""
    out, said = tmp_path / "run", tmp_path / "said"
    words = *TOPICS, "dataset.size=[64,48]", *OF_ROOM, f"hydra.run.dir={out}"
    publisher = published(tmp_path)
    try:
        process, heard = own_process.begin("experiments.ros", *words, said=said), Heard()
        own_process.wait_for(heard.has_enough, process, 600)
        assert heard.ask("save").success, said.read_text()
        process.kill()
        killed = process.pid
        assert own_process.ended(process) == -signal.SIGKILL
        saved = read_run(out / "saved-1")
        assert len(saved.frames) > 5 and saved.is_placed.all() and saved.map.gaussians.valid.any()
        log = out / "frames.jsonl"
        log.unlink()
        process = own_process.begin("experiments.ros", *words, said=said)
        own_process.wait_for(lambda: log.exists() and len(log.read_text().splitlines()) > 5, process, 600)
        publisher.kill()
        assert own_process.ended(process, 600) == 0, said.read_text()
    finally:
        publisher.kill()
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames/tracked"] > 4 and "has given none for 10 s" in said.read_text()
    assert not [*out.glob(f".camera.{killed}.*")], "the images of the killed node are gone"
    np.testing.assert_array_equal(read_run(out / "saved-1").poses, saved.poses)


@pytest.mark.slow
def test_an_error_ends_the_node_by_one_line(tmp_path, shared_memory):
    """Symptom: "terminate called without an active exception", and an abort, as the thread of rclpy still ran."""
    words = *TOPICS[:2], "prior=stream", "dataset.size=[64,48]", *OF_ROOM, f"hydra.run.dir={tmp_path / 'run'}"
    publisher = published(tmp_path)
    try:
        found = subprocess.run(
            [sys.executable, "-m", "experiments.ros", *words],
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            timeout=600,
        )
    finally:
        publisher.kill()
    assert found.returncode == 1, found.stderr
    assert found.stderr.count("error: ") == 1 and "is not beside" in found.stderr and "terminate" not in found.stderr


def published(folder: Path, fps: float = 30.0) -> subprocess.Popen:
    """A publisher of the tiny room's frames with depth and odometry, over and over."""
    recorded = folder / "played"
    recorded.mkdir()
    for row, frame in enumerate(dataset()):
        cv2.imwrite(str(recorded / f"{row}.png"), frame.image[..., ::-1])
        given = {"depth": frame.depth, "T_world_camera": frame.T_world_camera, "intrinsics": dataset().intrinsics}
        np.savez(recorded / f"{row}.npz", **given)
    program = Path(__file__).parents[1] / "ros_publisher.py"
    return subprocess.Popen([sys.executable, program, recorded, str(fps)])


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
        self._node, self.map, self.path = rclpy.create_node("who_listens"), None, None
        self.updates, self.delays, self.diagnostics = 0, [], []
        latched = QoSProfile(
            depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._node.create_subscription(PointCloud2, "map", lambda cloud: setattr(self, "map", cloud), latched)
        self._node.create_subscription(PathMessage, "path", lambda path: setattr(self, "path", path), latched)
        self._node.create_subscription(PointCloud2, "map_update", self._count, 10)
        self._node.create_subscription(DiagnosticArray, "diagnostics", self.diagnostics.append, 10)
        self._clients = {name: self._node.create_client(Trigger, name) for name in ("save", "reset")}

    def _count(self, cloud) -> None:
        self.updates += 1
        self.delays.append(time.time() - cloud.header.stamp.sec - cloud.header.stamp.nanosec / 1e9)

    def has_enough(self) -> bool:
        self._rclpy.spin_once(self._node, timeout_sec=0.05)
        return self.map is not None and self.path is not None and len(self.path.poses) > 5 and self.updates > 3

    def ask(self, service: str):
        future, end = self._clients[service].call_async(self._trigger.Request()), time.monotonic() + 60
        while not future.done() and time.monotonic() < end:
            self._rclpy.spin_once(self._node, timeout_sec=0.05)
        return future.result()

    def points(self) -> np.ndarray:
        packed = np.frombuffer(bytes(self.map.data), np.float32).reshape(-1, 4)
        assert len(packed) == self.map.width and [field.name for field in self.map.fields] == ["x", "y", "z", "rgb"]
        return packed[:, :3]

    def last_status(self) -> str:
        return self.diagnostics[-1].status[0].message


BESIDE = Path(__file__).parents[3]
DESK = Path(os.environ.get("FR1_DESK", BESIDE / "shared/data/video_depth/fr1_desk"))
INVERSE_DEPTH = 1.15496, 0.26901  # of the network's values v: 1 / z = a v + b


@pytest.mark.weekly
@pytest.mark.skipif(not DESK.is_dir(), reason="FR1_DESK is no folder of TUM fr1/desk with depths")
def test_a_bag_of_fr1_desk_is_played_in_real_time_into_the_node(tmp_path, shared_memory, monkeypatch):
    """30 images a second, poses by motion capture; the test prints what docs/measurements/live.md has.

    The node compiles as a robot's does: the flags of the tests, which compile quickly, make it three times as slow.
    """
    monkeypatch.delenv("XLA_FLAGS")
    pytest.importorskip("rosbags", reason="bags: pip install -e .[rosbag]")
    import ros_bag

    def depth_of(taken: str) -> np.ndarray:
        values = cv2.imread(str(DESK / "video_depth_anything_small" / f"{taken}.png"), cv2.IMREAD_UNCHANGED) / 65535
        return 1 / (INVERSE_DEPTH[0] * values + INVERSE_DEPTH[1])

    frames = ros_bag.tum_frames(DESK, depth_of)
    ros_bag.write(tmp_path / "desk", frames, (258.653, 258.2345, 159.0715, 127.407), 2)
    sent, out, said = tmp_path / "sent", tmp_path / "run", tmp_path / "said"
    with sent.open("w") as numbers:
        player = subprocess.Popen([sys.executable, ros_bag.__file__, tmp_path / "desk"], stdout=numbers)
    words = *TOPICS, "view.every_s=0.1", "dataset.max_seconds=30", f"hydra.run.dir={out}"
    try:
        process, heard = own_process.begin("experiments.ros", *words, said=said), Heard()
        own_process.wait_for(lambda: heard.has_enough() and False, process, 600)
        assert own_process.ended(process) == 0, said.read_text()
    finally:
        player.kill()
    metrics = json.loads((out / "metrics.json").read_text())
    count = metrics["frames/tracked"] + 1
    delays, rate = np.array(heard.delays[1:-1]), metrics["camera/frames_per_second"]
    late = f"{np.median(delays):.2f} s behind, 95 % within {np.quantile(delays, 0.95):.2f} s"
    print(f"{count} maps, {rate:.2f} a second; {metrics['camera/num_dropped']:.0f} dropped; the cloud {late}")
    assert metrics["frames/lost"] == 0 and rate >= 2 and np.median(delays) < 1
    path = np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in heard.path.poses])
    truth = np.array([T[:3, 3] for _, _, T in frames])
    assert np.median(np.linalg.norm(path[:, None] - truth, axis=2).min(1)) < 0.03
