"""The compilation cache: shared, bounded, and never a reason to fail; oracle: what JAX says it compiled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from emgs_jax.device.settings import HALVES, cache_folder

pytestmark = pytest.mark.slow

PROGRAM = """
import sys
import jax, jax.numpy as jnp
from emgs_jax.device import settings
settings.MAX_BYTES = int(sys.argv[2])
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
settings.use_compilation_cache(None if sys.argv[1] == "None" else sys.argv[1])
for size in range(2, 5):
    jax.jit(lambda x: jnp.linalg.qr(jnp.sin(x) @ x.T)[0])(jnp.ones((size, 5))).block_until_ready()
print(events.count("/jax/compilation_cache/cache_hits"), events.count("/jax/compilation_cache/cache_misses"))
print(jax.config.jax_compilation_cache_dir)
"""


QUIET = {"TF_CPP_MIN_LOG_LEVEL": "3"}  # as experiments/__init__.py says to commands


def start(folder: object, max_bytes: int = 2**30, first: str = "", **environment: str) -> subprocess.Popen:
    variables = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")} | environment
    variables |= QUIET  # else jaxlib 0.10.1 calls every executable from the folder an error
    command = [sys.executable, "-c", first + PROGRAM, str(folder), str(max_bytes)]
    return subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> tuple[int, int, str, str]:
    """Hits, misses, the folder in use and what was said on the error stream."""
    said, complaints = process.communicate(timeout=200)
    assert process.returncode == 0, complaints
    counts, folder = said.splitlines()
    return *map(int, counts.split()), folder, complaints


def test_two_processes_that_start_at_once_share_a_new_folder_and_the_next_one_compiles_nothing(tmp_path):
    both = [start(tmp_path / "new"), start(tmp_path / "new")]
    for hits, misses, folder, complaints in map(finish, both):
        assert hits + misses >= 3 and folder == str(tmp_path / "new") and "rror" not in complaints
    hits, misses, _, complaints = finish(start(tmp_path / "new"))
    assert hits >= 3 and misses == 0 and complaints == ""


def test_the_folder_stays_within_its_bound(tmp_path):
    finish(start(tmp_path / "all"))
    whole = sum(path.stat().st_size for path in (tmp_path / "all").glob("*-cache"))
    finish(start(tmp_path / "some", whole // 2))
    assert 0 < sum(path.stat().st_size for path in (tmp_path / "some").glob("*-cache")) <= whole // 2


def test_a_folder_that_cannot_be_written_is_one_line_and_no_failure(tmp_path):
    (tmp_path / "file").touch()
    hits, _, folder, complaints = finish(start(tmp_path / "file" / "below"))
    assert hits == 0 and folder == "None"
    assert complaints.startswith("warning: nothing is kept of what JAX compiles") and complaints.count("\n") == 1


def test_a_folder_that_can_only_be_read_is_read_and_one_line_says_so(tmp_path):
    assert finish(start(tmp_path))[1] >= 3
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    refuse = "import tempfile; tempfile.TemporaryFile = lambda dir: open('/no such folder/x')"
    hits, misses, folder, complaints = finish(start(tmp_path, first=refuse))
    assert hits >= 3 and misses == 0 and folder == str(tmp_path)
    assert complaints.startswith("warning: nothing is kept of what JAX compiles") and complaints.count("\n") == 1
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("word", ["None", "off"])
def test_it_can_be_turned_off(tmp_path, word):
    hits, _, folder, complaints = finish(start(word, XDG_CACHE_HOME=str(tmp_path)))
    assert (hits, folder, complaints, list(tmp_path.iterdir())) == (0, "None", "", [])


def test_auto_is_below_the_users_cache_unless_jax_has_a_folder_already(tmp_path, monkeypatch):
    assert finish(start("auto", XDG_CACHE_HOME=str(tmp_path)))[2] == str(tmp_path / "emgs_jax" / "jax")
    other = str(tmp_path / "other")
    own = {"XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": other}
    assert finish(start("auto", **own))[2] == other
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert cache_folder() == Path("/home/somebody/.cache/emgs_jax/jax")


def test_a_program_is_kept_after_a_full_disk_has_left_half_of_another(tmp_path):
    """JAX 0.10.1 reads the time of every program before it keeps one: without one time it kept nothing ever again."""
    assert finish(start(tmp_path))[1] >= 3
    lost, *_ = tmp_path.glob("*-atime")
    lost.unlink()
    (tmp_path / "gone-atime").write_bytes(bytes(8))
    hits, misses, _, complaints = finish(start(tmp_path))
    assert (misses, complaints) == (1, "") and hits >= 2
    keys = [{path.name.removesuffix(half) for path in tmp_path.glob(f"*{half}")} for half in HALVES]
    assert keys[0] == keys[1]
    assert finish(start(tmp_path))[1] == 0
