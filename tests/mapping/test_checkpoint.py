"""A run that is stopped and goes on; oracle: the bits of the same run that nobody stopped."""

import contextlib
import itertools
import json
import os
import signal
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import mkdtemp

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from own_process import begin, ended, wait_for
from scene import assert_same, random_observation
from tiny_run import NUM_FRAMES, TINY, compose

import experiments.run
from emgs_jax.back_end.state import BackEnd, Node, Refusal
from emgs_jax.gaussian_map import empty_map
from emgs_jax.io.files import changes
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.mapping import tracking
from emgs_jax.mapping.atlas import Atlas, Submap, World
from emgs_jax.mapping.checkpoint import (
    CHECKPOINT_FILE,
    Checkpoint,
    CheckpointConfig,
    Keeper,
    load_checkpoint,
    save_checkpoint,
)
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import SlamState

pytestmark = pytest.mark.xdist_group("tiny")

# Strict gates, so that the map outgrows half the capacity of tiny_run, and has the shapes of its runs then.
GATES = ("slam.em.max_mahalanobis_sq=1", "slam.refinement.max_mahalanobis_sq_2d=1")
WEEKLY = pytest.mark.weekly
OVERRIDES = ("prior.level=1", "checkpoint.every=2", "slam.submap.map_capacity=512", *GATES)
GRAPH = ("graph=default", "graph.every=1")
LARGE = ("slam.submap.map_capacity=1024",)  # at once, as tiny_run has it
MOVING = ("slam/motion=default", "slam.motion.num_looks=2", "slam.motion.prior=1", "dataset.movers=1")
SHOWS_TIMES = {"metrics.json", "frames.jsonl", "overview.png", "report.html"}


def log_lines(folder: Path) -> list[dict]:
    """frames.jsonl without its times."""
    found = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if "seconds" not in key} for line in found]


class Stopped(BaseException):
    """As a signal is: nobody catches it as an error."""


@contextlib.contextmanager
def in_step(number: int, is_killed: bool, monkeypatch):
    """At this step; who is killed writes nothing any more."""
    steps, advance = itertools.count(), tracking.advance

    def counted(*arguments):
        if next(steps) == number:
            if is_killed:
                patch.setattr(Keeper, "save", lambda self: None)
            raise Stopped
        return advance(*arguments)

    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr(tracking, "advance", counted)
        yield


@contextlib.contextmanager
def in_gathering(number: int, monkeypatch):
    """Where the predictions of this view are gathered: the mapping waits."""

    def gather(views, *rest):
        for _ in itertools.islice(views, number):
            pass
        raise Stopped

    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr(experiments.run, "gather", gather)
        yield


@contextlib.contextmanager
def in_export(monkeypatch):
    """After all steps."""
    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr(experiments.run, "save_outputs", lambda *_: (_ for _ in ()).throw(Stopped))
        yield


@contextlib.contextmanager
def counted(monkeypatch):
    """The steps that are taken."""
    steps, advance = [], tracking.advance
    with monkeypatch.context() as patch:
        patch.setattr(tracking, "advance", lambda *arguments: steps.append(1) or advance(*arguments))
        yield steps


@cache
def whole(*more):
    """Folder and metrics of the run that nobody stops."""
    folder = Path(mkdtemp())
    return folder, experiments.run.run(compose(*OVERRIDES, *more), folder)


def goes_on(folder: Path, more: tuple[str, ...], num_steps: range, monkeypatch) -> None:
    """The same command takes so many steps, and comes to what the run that nobody stopped has."""
    with counted(monkeypatch) as steps:
        found = experiments.run.run(compose(*OVERRIDES, *more), folder)
    assert len(steps) in num_steps, "the steps before are not repeated"
    expected, metrics = whole(*more)
    assert metrics["map/capacity"] == 1024, "the map had to grow"
    names = {path.name for path in expected.iterdir()}
    assert {path.name for path in folder.iterdir()} == names
    for name in names - SHOWS_TIMES:
        assert (folder / name).read_bytes() == (expected / name).read_bytes(), name
    assert log_lines(folder) == log_lines(expected)
    same = [key for key in metrics if not key.startswith(("time/", "memory/"))]
    assert {key: found[key] for key in same} == {key: metrics[key] for key in same}


@pytest.mark.parametrize(
    ("stop", "more", "num_steps"),
    [
        (partial(in_step, 3, True), LARGE, range(1, NUM_FRAMES - 1)),
        pytest.param(partial(in_step, 3, True), (), range(1, NUM_FRAMES - 1), marks=pytest.mark.slow),
        pytest.param(partial(in_step, 1, False), (), range(1, NUM_FRAMES - 1), marks=WEEKLY),
        pytest.param(partial(in_step, 3, False), GRAPH, range(1, NUM_FRAMES - 1), marks=WEEKLY),
        pytest.param(partial(in_step, 3, True), ("baseline=voxel",), range(1, NUM_FRAMES - 1), marks=WEEKLY),
        pytest.param(in_export, (), range(1), marks=pytest.mark.slow),
        pytest.param(in_export, GRAPH, range(1), marks=WEEKLY),
        pytest.param(partial(in_step, 3, True), MOVING, range(1, NUM_FRAMES - 1), marks=WEEKLY),
    ],
)
def test_a_run_that_is_stopped_and_goes_on_has_the_same_bits(tmp_path, monkeypatch, capsys, stop, more, num_steps):
    with stop(monkeypatch):
        experiments.run.run(compose(*OVERRIDES, *more), tmp_path)
    assert (tmp_path / CHECKPOINT_FILE).exists()
    goes_on(tmp_path, more, num_steps, monkeypatch)
    assert "resuming after frame" in "".join(capsys.readouterr())
    if more == MOVING:  # what later frames said of an earlier one was known before the stop, and is afterwards
        assert [line["moving"] > 0 for line in log_lines(tmp_path)][:4].count(True) >= 2


@pytest.mark.slow
def test_a_run_that_is_stopped_where_its_predictions_are_gathered_has_written_its_map_in_its_own_unit(
    tmp_path, monkeypatch
):
    """Symptom: the mapping was still waiting, so its checkpoint was not written and its path was in another unit."""
    with in_gathering(NUM_FRAMES - 1, monkeypatch):
        experiments.run.run(compose(*OVERRIDES, *GRAPH), tmp_path)
    with np.load(tmp_path / CHECKPOINT_FILE) as file:
        signature = json.loads(str(file["__header__"]))["signature"]
    records = load_checkpoint(tmp_path / CHECKPOINT_FILE, signature).records
    placed = np.stack([record.pose[:3, 3] for record in records])  # as the frames were placed
    _, written = load_trajectory_tum(tmp_path / "trajectory.txt")
    factors = np.linalg.norm(np.diff(written[:, :3, 3], axis=0), axis=1) / np.linalg.norm(
        np.diff(placed, axis=0), axis=1
    )
    assert len(placed) >= NUM_FRAMES - 1 and abs(factors[0] - 1) > 1e-4
    np.testing.assert_allclose(factors, factors[0], rtol=1e-5)
    goes_on(tmp_path, GRAPH, range(3), monkeypatch)


@pytest.mark.slow
def test_a_scheduler_ends_a_run_with_one_word_and_the_same_command_goes_on(tmp_path, monkeypatch):
    folder, said = tmp_path / "run", tmp_path / "said"
    words = (*TINY, *OVERRIDES, f"hydra.run.dir={folder}")
    program, log = begin("experiments.run", *words, said=said), folder / "frames.jsonl"
    wait_for(lambda: log.exists() and log.read_bytes().count(b"\n") >= 3, program)
    os.kill(program.pid, signal.SIGTERM)
    assert ended(program) == 128 + signal.SIGTERM, said.read_text()
    assert "terminated\n" in said.read_text() and "Traceback" not in said.read_text()
    assert f"the same command with hydra.run.dir={folder} resumes there" in said.read_text()
    with counted(monkeypatch) as steps:
        experiments.run.run(compose(*OVERRIDES), folder)
    assert len(steps) < NUM_FRAMES - 1, "in another process"
    for name in ("map.npz", "trajectory.txt"):
        assert (folder / name).read_bytes() == (whole()[0] / name).read_bytes(), name


@pytest.mark.weekly
@pytest.mark.parametrize("more", [(), GRAPH])
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_killed_at_any_time_again_and_again_comes_to_the_same_bits(tmp_path, sign, more):
    """Before its first frame, between frames, and while it exports: every file is whole or not there."""
    folder, said, log = tmp_path / "run", tmp_path / "said", tmp_path / "run" / "frames.jsonl"
    words = (*TINY, *OVERRIDES, *more, f"hydra.run.dir={folder}")
    rng, expected = np.random.default_rng(0), whole(*more)[0]
    for num_lines in (0, 2, NUM_FRAMES - 1, NUM_FRAMES):
        program = begin("experiments.run", *words, said=said)
        is_there = partial(
            lambda count: not count or log.exists() and log.read_bytes().count(b"\n") >= count, num_lines
        )
        wait_for(is_there, program)
        time.sleep(rng.uniform(0, 2))
        os.kill(program.pid, sign)
        assert ended(program) in (0, -sign, 128 + sign), said.read_text()
        for name in ("map.npz", "trajectory.txt", "metrics.json"):
            if (folder / name).exists():
                assert (folder / name).stat().st_size == (expected / name).stat().st_size or name in SHOWS_TIMES
    assert ended(begin("experiments.run", *words, said=said)) == 0 and "Traceback" not in said.read_text()
    for path in expected.iterdir():
        if path.name not in SHOWS_TIMES:
            assert (folder / path.name).read_bytes() == path.read_bytes(), path.name
    assert log_lines(folder) == log_lines(expected) and not [*folder.glob(".*tmp*")]


def test_a_run_does_not_go_on_in_the_map_that_it_would_replace(tmp_path):
    with pytest.raises(ValueError, match="is the folder of this run, too: give hydra.run.dir=ANOTHER"):
        experiments.run.run(compose(f"map={tmp_path}", "graph=default"), tmp_path)


@pytest.mark.slow
def test_another_command_in_the_folder_begins_anew_and_says_why(tmp_path, monkeypatch, capsys):
    with in_step(2, False, monkeypatch):
        experiments.run.run(compose(*OVERRIDES), tmp_path)
    metrics = experiments.run.run(compose(*OVERRIDES, "slam.em.noise=0.5"), tmp_path)
    assert metrics["frames/tracked"] > 0
    text = "".join(capsys.readouterr())
    assert "config.slam.em.noise was" in text and "starts at its first frame" in text
    assert (tmp_path / "previous-1" / CHECKPOINT_FILE).exists(), "nothing is lost"


def checkpoint() -> Checkpoint:
    pose = np.arange(16.0).reshape(4, 4) / 3
    records = [FrameRecord(0, "a", 0.1, "initialization", pose=pose, raw_pose=pose, num_gaussians=3, seconds=1 / 3)]
    records += [FrameRecord(1, None, None, "lost", reason="why", pose=pose, residual=float("nan"))]
    records += [FrameRecord(2, "c", 0.3, "tracked", pose=pose, covariance=np.arange(36.0).reshape(6, 6) / 7)]
    state = SlamState(empty_map(4, 2), random_observation(3), jaxlie.SE3.identity(), exact_estimate(), jnp.asarray(2))
    end = BackEnd(None, (1.0, 1.0, 0.5, 0.5), 0.01, nodes=(Node(pose, pose, 0.1, 0),), queries={(0, 1): "silent"})
    end = replace(end, refusals=(Refusal(0, 1, "matches", float("nan")),), active=1)
    return Checkpoint(2, Atlas(None, None, end, {1: Submap(state)}, World(2, pose, pose)), (64, 32), tuple(records))


def test_what_is_read_is_what_was_written(tmp_path):
    save_checkpoint(tmp_path / "c.npz", checkpoint(), {"a": 1})
    found, wrote = load_checkpoint(tmp_path / "c.npz", {"a": 1}), checkpoint()
    assert (found.num_inputs, found.capacities) == (2, (64, 32))
    assert_same(found.atlas.state, wrote.atlas.state)
    for one, other in (
        *zip(found.records, wrote.records, strict=True),
        (found.atlas.world, wrote.atlas.world),
        *zip(found.atlas.graph.nodes, wrote.atlas.graph.nodes, strict=True),
    ):
        np.testing.assert_equal(vars(one), vars(other))
    assert found.atlas.graph.queries == wrote.atlas.graph.queries and found.atlas.graph.active == 1
    np.testing.assert_equal(found.atlas.graph.refusals, wrote.atlas.graph.refusals)


@pytest.mark.parametrize("length", [0, 10, 400, -20])
def test_a_damaged_file_is_no_checkpoint_and_no_error(tmp_path, length):
    path = tmp_path / "c.npz"
    save_checkpoint(path, checkpoint(), {})
    path.write_bytes(path.read_bytes()[:length])
    keeper = Keeper(path, CheckpointConfig(2), {})
    assert keeper.found is None and f"{path} cannot be resumed" in keeper.note
    assert "starts at its first frame" in keeper.note


def test_without_a_number_of_frames_nothing_is_written_or_read(tmp_path):
    path = tmp_path / "c.npz"
    save_checkpoint(path, checkpoint(), {})
    keeper = Keeper(path, CheckpointConfig(0), {})
    assert keeper.found is None and keeper.note is None


def test_differences_are_named_by_their_keys():
    one = {"config": {"slam": {"a": 1, "b": 2}}, "git": None}
    assert changes(one, one) == []
    other = {"config": {"slam": {"a": 1, "b": 3}}, "git": "x"}
    assert changes(one, other) == ["config.slam.b was 2, now it is 3", "git was None, now it is 'x'"]
    assert changes({}, {"git": "x"}) == ["git was None, now it is 'x'"] and not changes({}, {"git": "x"}, ("git",))
