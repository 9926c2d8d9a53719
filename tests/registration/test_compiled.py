"""What the compiler makes of the fine step at the sizes of a run, with the optimisations that the tests switch off."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_the_compiled_derivative_of_the_rows_is_that_of_every_unknown_by_itself():
    """Versions that pyproject.toml excludes fail here: with 0.10.2 the scale's column of the colour rows was x's."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, str(TESTS / "compiled_rows.py")]
    done = subprocess.run(command, cwd=TESTS.parent, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
