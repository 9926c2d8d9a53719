"""Shared by all tests of the core: shapes and types checked at every call, one small config, one small camera."""

import gc
import os
import re
import sys
import traceback
from functools import cache
from importlib.metadata import version
from pathlib import Path

from emgs_jax.device.settings import cache_folder

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
    # And one thread for each executable: to split a small one costs a sixth more than it saves.
    QUICK += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["XLA_FLAGS"] = " ".join([*QUICK, os.environ.get("XLA_FLAGS", "")])

# Programs are kept, thousands of objects each: to look through them again and again is a tenth of the time.
gc.set_threshold(100_000, 20, 50)

import absl.logging  # noqa: E402
import jax  # noqa: E402
import omegaconf._utils  # noqa: E402
import pytest  # noqa: E402
import yaml  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

# optax brings absl, whose handler closes the stream that it was made with, pytest's own, when Hydra sets up logging.
absl.logging.get_absl_handler().python_handler.stream = sys.__stderr__


def loader_of_c(make=omegaconf._utils.get_yaml_loader):
    """OmegaConf's loader on that of libyaml: a composition by Hydra reads some thirty files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yaml, "SafeLoader", getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        return make()


omegaconf._utils.get_yaml_loader = cache(loader_of_c)
MAX_MAPS = 30000  # and no file of tests makes as many again
PACKAGE = Path(__file__).resolve().parents[1] / "emgs_jax"
# Before anything imports the package: every file that declares shapes of JAX arrays has them checked at every call.
CHECKED = [path for path in sorted(PACKAGE.rglob("*.py")) if "from jaxtyping import Array" in path.read_text()]
install_import_hook(
    [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in CHECKED], "beartype.beartype"
)


LAST = "passed"  # where pytest's cache has what passed in the last run
PASSED = set()  # in this one


def pytest_addoption(parser):
    parser.addoption("--not-again", action="store_true", help="leave out what passed in the last run, as .ci/run does")


def pytest_runtest_logreport(report):
    if report.when == "call" and report.passed:
        PASSED.add(report.nodeid)


def pytest_sessionfinish(session):
    # The processes of xdist have `workerinput`; there is no cache with `-p no:cacheprovider`.
    if not hasattr(session.config, "workerinput") and hasattr(session.config, "cache"):
        session.config.cache.set(LAST, sorted(PASSED))


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(config, items):
    """Weekly tests are left out unless `-m` names them; groups of several files come first, as they take longest."""
    passed = set(config.cache.get(LAST, []) if config.option.not_again else [])
    weekly = "weekly" in config.option.markexpr
    left_out = [item for item in items if item.nodeid in passed or not weekly and item.get_closest_marker("weekly")]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in set(left_out)]
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)


@cache
def group_of(file: str) -> str:
    """What the file's mark `xdist_group` says, else the file itself."""
    found = re.search(r'xdist_group\("(\w+)"\)', (PACKAGE.parent / file).read_text(encoding="utf-8"))
    return found[1] if found else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """`--dist loadgroup`, which in xdist 3.8.0 does nothing with pytest 9.2: that has no `_nodeid` to write groups to.

    A file without a mark is a group too.
    """
    from xdist.scheduler import LoadFileScheduling

    class LoadGroups(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid.split("::")[0])

    return LoadGroups(config, log) if config.getvalue("dist") == "loadgroup" else None


@pytest.fixture(scope="session", autouse=True)
def products_in_full_float32():
    """On recent GPUs a float32 product that does not ask for it is rounded to ten bits, which no CPU shows.

    In splats' fit it cost 1.2 dB. Refused for all that a command calls; tests of parts may call them bare.
    """
    product = jax.lax.dot_general_p
    bind = product.bind

    def asking(*factors, **parameters):
        is_float32 = all(str(getattr(factor, "dtype", "")) == "float32" for factor in factors)
        if is_float32 and parameters["precision"] is None:
            files = [Path(frame.filename) for frame in traceback.extract_stack()]
            if any(file.parent == PACKAGE.parent / "experiments" for file in files):
                mine = [str(file.relative_to(PACKAGE)) for file in files if file.is_relative_to(PACKAGE)]
                raise AssertionError(f"a product without @full_precision, called through {mine[-3:]}")
        return bind(*factors, **parameters)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(product, "bind", asking)
        yield


@pytest.fixture(scope="session", autouse=True)
def own_structures(tmp_path_factory):
    """Structures are not kept where commands keep theirs."""
    import emgs_jax.structure.store  # after the hook

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emgs_jax.structure.store, "CACHE", tmp_path_factory.mktemp("structures"))
        yield


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


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory):
    """One for all processes of this call of pytest."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def exact_run(shared_folder):
    """Folder and metrics of a tiny run with the exact prior, made once for all processes: nobody writes into it."""
    from tiny_run import make_exact_run  # after the hook

    return make_exact_run(shared_folder)


@pytest.fixture(autouse=True, scope="module")
def drop_executables():
    """Every executable holds some 13 memory maps, of which Linux gives 65530: past that, compiling segfaults.

    Until then they are kept, because other files need the same: making anew what a tiny run takes costs 10 CPU
    seconds. No memory is gained by dropping them.
    """
    yield
    if num_maps() > MAX_MAPS:
        jax.clear_caches()


def num_maps() -> int:
    """Memory maps of this process; more than `MAX_MAPS` where the system does not tell."""
    try:
        with open("/proc/self/maps", "rb") as file:
            return sum(1 for _ in file)
    except OSError:
        return MAX_MAPS + 1


@pytest.fixture(scope="session")
def chromium():
    """One browser for all pages: the files that use it are one xdist_group; `chromium.fresh()` is one of its own."""
    from browser import MISSING, browser

    if MISSING is not None:
        pytest.skip(MISSING)
    with browser() as one:
        yield one
