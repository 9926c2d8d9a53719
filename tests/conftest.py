"""Shared by all tests of the core: shapes and types checked at every call, one small config, one small camera."""

import os
from collections import Counter
from importlib.metadata import version
from pathlib import Path

from emgs_jax.running.compilation import cache_folder

# Before JAX is imported, and for the processes that tests start: most of the time of the tests is compilation. Not
# where commands keep theirs: that has a limit, for which JAX reads the whole folder, thousands of files, to add one.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder().with_name("jax_tests")))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Likewise: what jaxlib 0.10.1 logs of every executable from the cache fills the pipes of those processes.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

# Likewise: small arrays need no thorough compilation, and an oracle holds for any. Flags of the user come last and win.
QUICK = ["--xla_backend_optimization_level=0"]
if tuple(map(int, version("jaxlib").split(".")[:2])) <= (0, 10):  # XLA ends the process at a flag that it does not know
    QUICK.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([*QUICK, os.environ.get("XLA_FLAGS", "")])

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

PACKAGE = Path(__file__).resolve().parents[1] / "emgs_jax"
# Before anything imports the package: every file that declares shapes of JAX arrays has them checked at every call.
CHECKED = [path for path in sorted(PACKAGE.rglob("*.py")) if "from jaxtyping import Array" in path.read_text()]
install_import_hook(
    [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in CHECKED], "beartype.beartype"
)


def pytest_collection_modifyitems(items):
    """Files with most slow tests first: a long one at the end would leave the other processes without work."""
    num_slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -num_slow[item.path])


@pytest.fixture(scope="session")
def config():
    """`config("slam.em.noise=0", ...)`: a small SlamConfig from conf/ with Hydra overrides."""
    from scene import slam_config  # after the hook

    return slam_config


@pytest.fixture(scope="session")
def camera():
    """fx ≠ fy, cx ≠ cy, H ≠ W."""
    from emgs_jax.ops.camera import Camera

    return Camera([20.0, 23.0], [14.5, 12.25], 32, 24)


@pytest.fixture(autouse=True, scope="module")
def drop_executables():
    """Every executable holds memory maps, of which Linux gives a process 65530: past that, compiling segfaults."""
    yield
    jax.clear_caches()
