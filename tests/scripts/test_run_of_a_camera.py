"""A run over a camera: what it maps, against a run over its recording and the truth; how it ends."""

import json
import os
import signal
import time

import cv2
import numpy as np
import own_process
import pytest
from tiny_run import TINY, dataset

import experiments.run
from emgs_jax.config import configure
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.live import capture
from emgs_jax.live.newest import Shot

pytestmark = pytest.mark.xdist_group("tiny")

OF_ROOM = [word for word in TINY if not word.startswith("dataset.")]
INTRINSICS = "dataset.intrinsics=[{},{},{},{}]".format(*dataset().intrinsics)


def shots():
    """The tiny room's frames with their depth and pose."""
    for row, frame in enumerate(dataset()):
        given = {"depth": frame.depth, "T_world_camera": frame.T_world_camera}
        yield Shot(100.0 + 0.1 * row, frame.image, given)


@pytest.fixture
def camera(monkeypatch):
    """A camera whose next image comes when the last one has been taken; the first one comes twice."""
    newest = []

    def start(source, into, needs_camera):
        newest.append(into)
        begin(source, into)

    def one_by_one(source, into):
        first, *rest = shots()
        for shot in (first, first, *rest):
            while newest[-1]._shot is not None:
                time.sleep(0.001)
            yield shot

    begin = capture.start
    monkeypatch.setattr("emgs_jax.live.camera.start", start)
    monkeypatch.setattr(capture, "open_source", one_by_one)


@pytest.mark.slow
def test_a_camera_is_mapped_as_its_recording_bit_for_bit_and_the_run_is_one_of_the_recording(tmp_path, camera):
    words = "dataset=camera", "dataset.source=7", "dataset.record=true", "dataset.size=[64,48]", INTRINSICS
    live = experiments.run.run(composed(*words, "prior=stream"), tmp_path / "live")
    words = "dataset=images", f"dataset.root={tmp_path}/live/recorded", "dataset.size=[64,48]", INTRINSICS
    experiments.run.run(composed(*words, "prior=stream"), tmp_path / "again")
    for name in ("map.npz", "trajectory.txt", "points.ply"):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    times, poses = load_trajectory_tum(tmp_path / "live" / "trajectory.txt")
    truth = np.stack([frame.T_world_camera for frame in dataset()])
    np.testing.assert_allclose(times, 100.0 + 0.1 * np.arange(len(truth)), atol=1e-6)
    np.testing.assert_allclose(poses, np.linalg.inv(truth[0]) @ truth, atol=0.01)
    assert live["frames/tracked"] == len(truth) - 1 and live["camera/num_dropped"] == 0
    found, again = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("live", "again"))
    assert found["provenance"]["data"]["fingerprint"] == again["provenance"]["data"]["fingerprint"]
    assert found["provenance"]["config"]["dataset"]["root"] == str(tmp_path / "live" / "recorded")
    assert (tmp_path / "live" / "report.html").is_file() and not (tmp_path / "live" / "checkpoint.npz").exists()


def composed(*words: str):
    """The tiny setting with a data set that is not the built-in room."""
    return configure.compose(*OF_ROOM, *words)


def test_without_depth_and_pose_beside_its_images_a_camera_has_no_stream(tmp_path, monkeypatch):
    monkeypatch.setattr(capture, "open_source", lambda source, into: (Shot(1.0, frame.image) for frame in dataset()))
    words = "dataset=camera", "dataset.source=7", "dataset.size=[64,48]", INTRINSICS, "prior=stream"
    with pytest.raises(ValueError, match=r"1.000000.npz is not beside .*choose another prior"):
        experiments.run.run(composed(*words), tmp_path)
    assert not (tmp_path / "map.npz").exists()


@pytest.mark.slow
def test_one_ctrl_c_ends_the_camera_and_the_map_is_finished(tmp_path):
    """Of a recording that is played in real time, ten images a second, back and forth for ten minutes."""
    recorded, frames = tmp_path / "played", [*shots()]
    recorded.mkdir()
    for row in range(600):
        shot = frames[abs((row + 5) % 10 - 5)]
        cv2.imwrite(str(recorded / f"{0.1 * row:.6f}.png"), shot.image[..., ::-1])
        np.savez(recorded / f"{0.1 * row:.6f}.npz", **shot.given)
    out, said = tmp_path / "run", tmp_path / "said"
    words = f"camera:{recorded}", "dataset.size=[64,48]", INTRINSICS, "prior=stream", f"hydra.run.dir={out}"
    process = own_process.begin("experiments.run", *words, *OF_ROOM, said=said)
    log = out / "frames.jsonl"
    own_process.wait_for(lambda: log.exists() and len(log.read_text().splitlines()) > 8, process)
    os.kill(process.pid, signal.SIGINT)
    assert own_process.ended(process) == 0, said.read_text()
    assert "no more images are taken; the map is finished and written" in said.read_text()
    metrics = json.loads((out / "metrics.json").read_text())
    assert 8 < metrics["frames/tracked"] < 599 and metrics["camera/num_dropped"] >= 0
    assert (out / "map.npz").is_file() and (out / "report.html").is_file() and not (out / "recorded").exists()
