"""A command in a process of its own, forked off one that has the imports done: .1 CPU seconds in place of 3.

The process has JAX imported, though no backend started: where a fresh interpreter is what a test is about (what is
imported, variables that JAX reads as it is imported, what happens as Python ends), start `sys.executable`.
"""

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from multiprocessing.process import BaseProcess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONTEXT = multiprocessing.get_context("forkserver")
# What the commands import, but nothing of this package.
HEAVY = [
    *("jax", "jax.numpy", "jax.experimental.compilation_cache.compilation_cache", "equinox", "jaxlie", "lineax"),
    *("optimistix", "hydra", "hydra.main", "hydra.core.hydra_config", "hydra._internal.core_plugins", "omegaconf"),
    *("cv2", "open3d", "scipy.spatial", "scipy.stats", "scipy.optimize", "trimesh", "tqdm", "yaml", "filelock"),
    *("matplotlib.backends.backend_agg", "matplotlib.figure"),
]
CONTEXT.set_forkserver_preload(HEAVY)


def _inside(module: str, words: tuple[str, ...], said: tuple[str, str], environment: dict[str, str]) -> None:
    for number, path in zip((1, 2), said, strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(ROOT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    warnings.filterwarnings("ignore", message=".*found in sys.modules after import of package")
    sys.argv = [module, *words]
    sys.path.insert(0, str(ROOT))
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def begin(module: str, *words: str, said: Path, errors: Path | None = None) -> BaseProcess:
    """`python -m module words` that goes on by itself; what it says is appended to files.

    Args:
        module: with a `__main__`.
        words: its arguments.
        said: of the standard output.
        errors: of the standard error; with the output where it is None.
    """
    files = str(said), str(errors or said)
    process = CONTEXT.Process(target=_inside, args=(module, words, files, dict(os.environ)), daemon=True)
    process.start()
    return process


def run(module: str, *words: str, timeout: float = 300.0) -> subprocess.CompletedProcess:
    """As `subprocess.run([sys.executable, "-m", module, *words], cwd=ROOT, capture_output=True, text=True)`."""
    with tempfile.TemporaryDirectory() as folder:
        said, errors = Path(folder) / "said", Path(folder) / "errors"
        said.touch()
        errors.touch()
        process = begin(module, *words, said=said, errors=errors)
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            raise TimeoutError(f"{module} {' '.join(words)} has no end after {timeout:g} s: {errors.read_text()}")
        return subprocess.CompletedProcess([module, *words], process.exitcode, said.read_text(), errors.read_text())


def ended(process: BaseProcess, timeout: float = 300.0) -> int:
    """The exit status, negative for a signal; TimeoutError after so many seconds."""
    process.join(timeout)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(f"no end after {timeout:g} s")
    return process.exitcode


def wait_for(condition, process: BaseProcess, timeout: float = 300.0) -> None:
    """Until `condition()` holds or the process ends."""
    end = time.monotonic() + timeout
    while process.is_alive() and not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)
