"""Who shares the GPU with PyTorch: what the config says, in every command."""

import os
import subprocess
import sys

import pytest
from tiny_run import CONF, compose

from emgs_jax.config import configure
from emgs_jax.device.settings import check_platforms, leave_memory_to_torch

KEY = "XLA_PYTHON_CLIENT_PREALLOCATE"


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.setenv(KEY, "")  # so that what a test sets is undone
    monkeypatch.delenv(KEY)


@pytest.mark.parametrize(
    ("overrides", "is_shared"),
    [
        ((), False),
        (("prior=multiview_stereo", "features=random"), False),
        (("prior=recorded", "prior.folder=predictions"), False),
        (("prior=mapanything",), True),
        (("prior=recorded", "prior.folder=predictions", "features=dinov2_text", "features.checkpoint=weights"), True),
    ],
)
def test_memory_is_left_where_a_network_runs_in_torch(overrides, is_shared):
    """JAX's backend was up, with 75 % of the memory, before torch loaded."""
    leave_memory_to_torch(compose(*overrides))
    assert os.environ.get(KEY) == ("false" if is_shared else None)


def test_jobs_of_an_evaluation_say_it_in_words():
    config = configure.compose("suite=smoke", "overrides=['prior=mapanything']", name="evaluate")
    leave_memory_to_torch(config)
    assert os.environ[KEY] == "false"


def test_what_a_user_has_set_stays(monkeypatch):
    monkeypatch.setenv(KEY, "true")
    leave_memory_to_torch(compose("prior=mapanything"))
    assert os.environ[KEY] == "true"


def test_a_command_says_it_before_its_task(tmp_path):
    program = (
        "import os, sys\nfrom experiments.command import command\n"
        f"@command('config')\ndef main(config):\n    print('set', os.environ.get('{KEY}'), 'jax' in sys.modules)\n"
        "main()\n"
    )
    words = ["prior=mapanything", "compilation_cache=off", f"hydra.run.dir={tmp_path}"]
    ran = subprocess.run(
        [sys.executable, "-c", program, *words], capture_output=True, text=True, cwd=CONF.parent, check=True
    )
    assert "set false" in ran.stdout


def test_a_device_that_jax_does_not_find_is_named():
    """JAX_PLATFORMS=cuda without jax[cuda13] ended in "error: AssertionError"."""
    code = "from emgs_jax.device.settings import check_platforms; check_platforms()"
    for platforms, words in (
        ("cpu", ""),
        ("nonsense", "ValueError: JAX_PLATFORMS=nonsense, and JAX finds no such dev"),
    ):
        environment = os.environ | {"JAX_PLATFORMS": platforms}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert words in done.stderr and bool(words) == bool(done.returncode)


def test_a_backend_that_fails_without_a_word_is_named_too(monkeypatch):
    import jax

    def without_a_word():
        raise AssertionError

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr(jax, "devices", without_a_word)
    with pytest.raises(ValueError, match="JAX_PLATFORMS=cuda, and JAX finds no such device: install"):
        check_platforms()
