"""Who shares the GPU with PyTorch: what the config says, in every command."""

import os
import subprocess
import sys
from unittest import mock

import pytest
from tiny_run import CONF

from emgs_jax.config import configure
from emgs_jax.device.settings import check_platforms, leave_memory_to_torch

pytestmark = pytest.mark.slow


KEY = "XLA_PYTHON_CLIENT_PREALLOCATE"


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.setenv(KEY, "")  # so that what a test sets is undone
    monkeypatch.delenv(KEY)


@pytest.mark.parametrize(
    ("overrides", "value"),
    [
        ((), None),
        (("prior=multiview_stereo", "features=random"), None),
        (("prior=recorded", "prior.folder=predictions"), None),
        (("prior=mapanything",), "false"),
        (("prior=recorded", "prior.folder=a", "features=dinov2_text", "features.checkpoint=weights"), "false"),
        (("suite=smoke", "overrides=['prior=mapanything']"), "false"),
    ],
)
def test_memory_is_left_where_a_network_runs_in_torch(monkeypatch, overrides, value):
    """JAX's backend was up, with 75 % of the memory, before torch loaded. Jobs of an evaluation say it in words."""
    config = configure.compose(*overrides, name="evaluate" if "suite=smoke" in overrides else "config")
    leave_memory_to_torch(config)
    assert os.environ.get(KEY) == value
    monkeypatch.setenv(KEY, "true")  # by the user
    leave_memory_to_torch(config)
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


@pytest.mark.parametrize("platforms", ["cpu", "nonsense"])
def test_a_device_that_jax_does_not_find_is_named(platforms):
    """JAX_PLATFORMS=cuda without jax[cuda13] ended in "error: AssertionError"."""
    command = [sys.executable, "-c", "from emgs_jax.device.settings import check_platforms; check_platforms()"]
    environment = os.environ | {"JAX_PLATFORMS": platforms}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    is_refused = "ValueError: JAX_PLATFORMS=nonsense, and JAX finds no such device" in done.stderr
    assert is_refused == bool(done.returncode) == (platforms != "cpu")


def test_a_backend_that_fails_without_a_word_is_named_too(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr("jax.devices", mock.Mock(side_effect=AssertionError))
    with pytest.raises(ValueError, match="JAX_PLATFORMS=cuda, and JAX finds no such device: install"):
        check_platforms()
