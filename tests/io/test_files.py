"""Oracles: what is on the disk after an interruption, a full disk and a cut line; strict JSON."""

import errno
import json
import os
import resource
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.io.files import FrameLog, atomic_write, jsonable, new_folder, owned, remove_temporaries, write_json
from emgs_jax.io.ply import save_points_ply


def test_an_interrupted_or_full_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "metrics.json"
    write_json(path, {"a": 1})
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as handle:
        handle.write(b"half")
        raise KeyboardInterrupt

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device.*metrics.json") as caught:
        write_json(path, {"a": 2})
    assert caught.value.errno == errno.ENOSPC
    with pytest.raises(OSError, match="points.ply"):
        save_points_ply(tmp_path / "points.ply", np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 3)))
    assert json.loads(path.read_text()) == {"a": 1}
    assert os.listdir(tmp_path) == ["metrics.json"]


def test_a_folder_is_held_by_one_program_at_a_time_and_let_go_when_it_dies(tmp_path):
    """Two runs in one folder mixed their outputs."""
    folder, code = tmp_path / "run", "import sys, time; from pathlib import Path; from emgs_jax.io.files import owned\n"
    code += "with owned(Path(sys.argv[1])):\n    print('held', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=r"another program is writing into .*run: wait"), owned(folder):
            pass
        other.kill()
    with owned(folder):
        assert os.listdir(folder) == []
    with owned(folder):  # once more, after it was let go
        pass


def test_a_new_folder_is_made_by_one_program_at_a_time_and_after_one_that_was_killed(tmp_path):
    """Two merges into one folder deleted each other's files."""
    with new_folder(tmp_path / "out") as first:
        (first / "map.npz").write_text("first")
        with pytest.raises(ValueError, match="another program is writing into"), new_folder(tmp_path / "out"):
            pass
        assert (first / "map.npz").read_text() == "first"
    with pytest.raises(ValueError, match="out is there already"), new_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "out/map.npz").read_text() == "first"
    (tmp_path / ".other.partial/below").mkdir(parents=True)
    (tmp_path / ".other.partial/old").write_text("of a program that was killed")
    with new_folder(tmp_path / "other") as folder:
        assert not [*folder.iterdir()]
    assert sorted(os.listdir(tmp_path)) == ["other", "out"]


def test_every_line_of_the_frame_log_is_on_disk_at_once_and_a_cut_one_is_taken_back(tmp_path):
    path = tmp_path / "frames.jsonl"
    path.write_text("of an older run\n")
    with FrameLog(path) as log:
        log.append({"frame": 0, "residual": np.float32("nan"), "counts": jnp.arange(2)})
        assert [json.loads(line) for line in path.read_text().splitlines()] == [
            {"frame": 0, "residual": None, "counts": [0, 1]}
        ]
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 5, limits[1]))  # room for five bytes
        try:
            with pytest.raises(OSError, match="File too large.*frames.jsonl"):
                log.append({"frame": 1})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        log.append({"frame": 2})
    assert [json.loads(line)["frame"] for line in path.read_text().splitlines()] == [0, 2]


def test_jsonable_is_strict_json_of_the_same_values():
    value = {"a": np.float32(0.5), "b": (np.int64(3), float("inf")), "c": np.array([1.0, np.nan]), 4: {"x", "y"}}
    expected = {"a": 0.5, "b": [3, None], "c": [1.0, None], "4": ["x", "y"]}
    assert json.loads(json.dumps(jsonable(value), allow_nan=False)) == expected
    assert jsonable(np.bool_(True)) is True


def test_what_killed_writes_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    """A process that is killed has no time to remove its temporary file."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    left, running = f".map.{dead.pid}.tmp.npz", f".map.{os.getppid()}.tmp.npz"
    others = [".map.npz", ".tmp", f".map.{dead.pid}.tmpx", "map.npz"]
    for name in (left, running, *others):
        (tmp_path / name).write_text("half")
    images = tmp_path / f".camera.{dead.pid}.tmp.abc"
    images.mkdir()
    (images / "0.png").write_text("an image")
    assert sorted(remove_temporaries(tmp_path)) == sorted([left, images.name])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([running, *others])
    with atomic_write(tmp_path / "map.npz") as handle:
        handle.write(b"whole")
        assert remove_temporaries(tmp_path) == []
    assert (tmp_path / "map.npz").read_bytes() == b"whole"
