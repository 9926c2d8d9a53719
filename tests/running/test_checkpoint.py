"""A run that is stopped and goes on; oracle: the bits of the same run that nobody stopped."""

import itertools
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONF, NUM_FRAMES, TINY, compose

import experiments.run
from emgs_jax.running import drive
from emgs_jax.running.checkpoint import (
    CHECKPOINT_FILE,
    Checkpoint,
    CheckpointConfig,
    Keeper,
    difference,
    load_checkpoint,
    save_checkpoint,
)
from emgs_jax.running.record import FrameRecord
from tools.kills.folders import log_lines

OVERRIDES = ("prior.level=1", "checkpoint.every=2", "slam.submap.map_capacity=256")


class Stopped(BaseException):
    """As a signal is: nobody catches it as an error."""


def stopped(folder, monkeypatch, overrides, after, is_killed):
    """A run that ends after so many steps; one that is killed writes nothing any more."""
    steps, advance = itertools.count(), drive.advance

    def counted(*arguments):
        if next(steps) == after:
            raise Stopped
        return advance(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(drive, "advance", counted)
        if is_killed:
            save, has_stopped = Keeper.save, lambda: next(steps) > after
            patch.setattr(Keeper, "save", lambda self: None if has_stopped() else save(self))
        with pytest.raises(Stopped):
            experiments.run.run(compose(*overrides), folder)


@cache
def whole(*more):
    """Folder and metrics of the run that nobody stops."""
    folder = Path(mkdtemp())
    return folder, experiments.run.run(compose(*OVERRIDES, *more), folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "after", "is_killed"),
    [
        ((), 1, False),
        ((), 3, True),
        (("graph=default", "graph.every=1"), NUM_FRAMES - 2, False),
        (("baseline=voxel",), 3, True),
    ],
)
def test_a_run_that_is_stopped_and_goes_on_has_the_same_bits(tmp_path, monkeypatch, capsys, more, after, is_killed):
    overrides = (*OVERRIDES, *more)
    folder, metrics = whole(*more)
    assert metrics["map/capacity"] > 256, "the map had to grow"
    stopped(tmp_path, monkeypatch, overrides, after, is_killed)
    assert (tmp_path / CHECKPOINT_FILE).exists()
    calls, advance = [], drive.advance
    monkeypatch.setattr(drive, "advance", lambda *arguments: calls.append(1) or advance(*arguments))
    found = experiments.run.run(compose(*overrides), tmp_path)
    assert 0 < len(calls) < NUM_FRAMES - 1, "the steps before are not repeated"
    assert "going on after frame" in "".join(capsys.readouterr())
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in folder.iterdir()}
    for name in {path.name for path in folder.iterdir()} - {
        "metrics.json",
        "frames.jsonl",
        "overview.png",
        "report.html",
    }:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name
    assert log_lines(tmp_path) == log_lines(folder)
    same = [key for key in metrics if not key.startswith(("time/", "memory/"))]
    assert {key: found[key] for key in same} == {key: metrics[key] for key in same}


@pytest.mark.slow
def test_a_scheduler_ends_a_run_with_one_word_and_the_same_command_goes_on(tmp_path):
    command = [sys.executable, "-m", "experiments.run", *TINY, *OVERRIDES, f"hydra.run.dir={tmp_path}"]
    log, errors = tmp_path / "frames.jsonl", tmp_path.with_suffix(".log")
    with open(errors, "w") as file:  # a pipe that nobody reads is full at some time
        program = subprocess.Popen(command, cwd=CONF.parent, stdout=file, stderr=subprocess.STDOUT)
        end = time.monotonic() + 300
        while program.poll() is None and not (log.exists() and log.read_bytes().count(b"\n") >= 3):
            assert time.monotonic() < end, "no third frame"
            time.sleep(0.01)
        program.send_signal(signal.SIGTERM)
        program.wait(timeout=300)
    said = errors.read_text()
    assert program.returncode == 128 + signal.SIGTERM, said
    assert "terminated\n" in said and "Traceback" not in said
    assert f"the same command with hydra.run.dir={tmp_path} goes on" in said
    done = subprocess.run(command, cwd=CONF.parent, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0 and "going on after frame" in done.stdout + done.stderr, done.stderr
    for name in ("map.npz", "trajectory.txt"):
        assert (tmp_path / name).read_bytes() == (whole()[0] / name).read_bytes(), name


@pytest.mark.slow
def test_a_run_that_is_stopped_while_it_writes_takes_no_step_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(experiments.run, "save_outputs", lambda *_: (_ for _ in ()).throw(Stopped))
        with pytest.raises(Stopped):
            experiments.run.run(compose(*OVERRIDES), tmp_path)
    monkeypatch.setattr(drive, "advance", lambda *_: pytest.fail("a step"))
    assert experiments.run.run(compose(*OVERRIDES), tmp_path)["frames/tracked"] > 0


@pytest.mark.slow
def test_a_run_that_is_stopped_where_its_predictions_are_gathered_ends_before_it_is_written(tmp_path, monkeypatch):
    """Symptom: the mapping was still waiting, so its checkpoint was not written and its path was in another unit."""
    order = []

    def gather(views, *rest):
        next(views)
        raise Stopped

    for module, name in ((drive, "in_own_unit"), (drive, "leave_out"), (experiments.run, "save_progress")):
        monkeypatch.setattr(module, name, lambda *_, name=name: order.append(name))
    monkeypatch.setattr(experiments.run, "gather", gather)
    with pytest.raises(Stopped):
        experiments.run.run(compose(*OVERRIDES), tmp_path)
    assert order == ["leave_out", "in_own_unit", "save_progress"] and (tmp_path / CHECKPOINT_FILE).exists()


def test_a_run_does_not_go_on_in_the_map_that_it_would_replace(tmp_path):
    with pytest.raises(ValueError, match="is the folder of this run, too: give hydra.run.dir=ANOTHER"):
        experiments.run.run(compose(f"map={tmp_path}", "graph=default"), tmp_path)


@pytest.mark.slow
def test_another_command_in_the_folder_begins_anew_and_says_why(tmp_path, monkeypatch, capsys):
    stopped(tmp_path, monkeypatch, OVERRIDES, 2, False)
    metrics = experiments.run.run(compose(*OVERRIDES, "slam.em.noise=0.5"), tmp_path)
    assert metrics["frames/tracked"] > 0
    text = "".join(capsys.readouterr())
    assert "config.slam.em.noise was" in text and "begins at its first frame" in text
    assert (tmp_path / "previous-1" / CHECKPOINT_FILE).exists(), "nothing is lost"


def checkpoint() -> Checkpoint:
    pose = np.arange(16.0).reshape(4, 4) / 3
    records = [FrameRecord(0, "a", 0.1, "initialization", pose=pose, raw_pose=pose, num_gaussians=3, seconds=1 / 3)]
    records += [FrameRecord(1, None, None, "lost", reason="why", pose=pose, residual=float("nan"))]
    records += [FrameRecord(2, "c", 0.3, "tracked", pose=pose, covariance=np.arange(36.0).reshape(6, 6) / 7)]
    return Checkpoint(2, [np.float32([0.1, 0.2]), jnp.asarray([True])], (64, 32), records)


def test_what_is_read_is_what_was_written(tmp_path):
    save_checkpoint(tmp_path / "c.npz", checkpoint(), {"a": 1})
    found, wrote = load_checkpoint(tmp_path / "c.npz", {"a": 1}), checkpoint()
    assert (found.num_inputs, found.capacities) == (2, (64, 32))
    for one, other in zip(found.leaves, wrote.leaves, strict=True):
        assert one.dtype == other.dtype and one.tobytes() == np.asarray(other).tobytes()
    for one, other in zip(found.records, wrote.records, strict=True):
        np.testing.assert_equal(vars(one), vars(other))


@pytest.mark.parametrize("length", [0, 10, 400, -20])
def test_a_damaged_file_is_no_checkpoint_and_no_error(tmp_path, length):
    path = tmp_path / "c.npz"
    save_checkpoint(path, checkpoint(), {})
    path.write_bytes(path.read_bytes()[:length])
    keeper = Keeper(path, CheckpointConfig(2), {})
    assert keeper.found is None and f"{path} cannot be gone on from" in keeper.note
    assert "begins at its first frame" in keeper.note


def test_without_a_number_of_frames_nothing_is_written_or_read(tmp_path):
    path = tmp_path / "c.npz"
    save_checkpoint(path, checkpoint(), {})
    keeper = Keeper(path, CheckpointConfig(0), {})
    assert keeper.found is None and keeper.note is None


def test_the_first_difference_is_named():
    one = {"config": {"slam": {"a": 1, "b": 2}}, "git": None}
    assert difference(one, one) is None
    assert difference(one, {"config": {"slam": {"a": 1, "b": 3}}, "git": "x"}) == "config.slam.b was 2, now it is 3"
    assert difference({}, {"git": "x"}) == "git was None, now it is 'x'"
