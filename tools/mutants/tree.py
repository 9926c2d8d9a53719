"""A copy of the repository in which files of tests are run, each in a process forked off with the imports done."""

import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from tools.mutants.choose import ROOT

# Imported once, before each run is forked off; none of them may start JAX's backend.
HEAVY = ["pytest", "jax", "jax.numpy", "equinox", "jaxlie", "optimistix", "beartype", "hydra", "scipy.spatial", "chex"]
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", re.MULTILINE)


class Cache:
    """Tests name a folder for executables in their conftest; here JAX is imported before that."""

    def pytest_configure(self) -> None:
        import jax

        jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def run_tests(root: str, test: str, log: str) -> None:
    """Run a file of tests in a tree, output to a file (in a process of its own)."""
    os.setsid()
    os.chdir(root)
    sys.path[:] = [root, *(entry for entry in sys.path if Path(entry or ".").resolve() != ROOT)]
    os.environ["PYTHONPATH"] = root
    with open(log, "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        import pytest

        options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=line", "-rfE"]
        code = pytest.main([*options, test], plugins=[Cache()])
    os._exit(int(code))  # what the tests registered to run at the end is of no use here


class Tree:
    """A copy of the repository's files, without what git ignores."""

    def __init__(self, folder: Path, timeout_s: float) -> None:
        self.root, self._log, self._timeout_s = folder / "tree", folder / "log.txt", timeout_s
        listed = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True)
        for name in filter(lambda name: (ROOT / name).is_file(), listed.splitlines()):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, self.root / name)

    def write(self, file: str, text: str) -> None:
        """Python takes a compiled file for this one's if both size and second are the same: away with it."""
        path = self.root / file
        path.write_text(text)
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):
            compiled.unlink()

    def failure(self, test: str) -> str:
        """Name of the first test of this file that fails; empty where all pass."""
        run = multiprocessing.get_context("forkserver").Process(
            target=run_tests, args=(str(self.root), test, str(self._log))
        )
        run.start()
        run.join(self._timeout_s)
        is_over = not run.is_alive()
        with contextlib.suppress(ProcessLookupError):  # those that a test started, too
            os.killpg(run.pid, signal.SIGKILL)
        run.join()
        if not is_over:
            return f"{test}: no answer after {self._timeout_s:.0f} s"
        if run.exitcode in (0, 5):  # all passed, or all are left out
            return ""
        found = FAILED.search(self._log.read_text()) if self._log.exists() else None
        return found[1] if found else f"{test}: ended with {run.exitcode}"
