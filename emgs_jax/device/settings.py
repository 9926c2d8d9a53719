"""Settings of JAX: the cache of compiled programs, and its share of a GPU's memory."""

import contextlib
import math
import os
import re
import sys
import tempfile
from pathlib import Path

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

MAX_BYTES = 2 * 2**30  # the least recently used go first
HALVES = "-cache", "-atime"  # ends of JAX's file names
# Targets of a config that run PyTorch, and words that select them.
IN_TORCH = re.compile(
    r"emgs_jax\.prior\.network\.|emgs_jax\.features\.dino\.|prior[=:] ?mapanything|features[=:] ?dinov\d_text"
)


def cache_folder() -> Path:
    """Return the default folder of compiled programs, below XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "emgs_jax" / "jax"


def use_compilation_cache(folder: str | None = "auto") -> None:
    """Keep compiled programs in a folder from now on; several processes may share it.

    Args:
        folder: `auto` is `cache_folder()`, unless JAX already has a folder (JAX_COMPILATION_CACHE_DIR or `jax.config`),
            which stays with its settings. None or `off` sets no folder. A folder that cannot be written to is only
            read, with a line that says so.
    """
    if folder is None or str(folder) in ("off", "False"):
        return
    try:
        import jax
    except ImportError:  # recording predictions needs no JAX, unless the prior does
        return
    if str(folder) == "auto" and jax.config.jax_compilation_cache_dir is not None:
        return
    try:
        path = cache_folder() if str(folder) == "auto" else Path(folder).expanduser()
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(b"is there room?")
        is_kept = True
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        print(f"warning: nothing is kept of what JAX compiles: {error}", file=sys.stderr)
        if not isinstance(error, OSError) or not os.access(path, os.R_OK | os.X_OK):
            return
        is_kept = False
    if is_kept:
        _remove_orphans(path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    # JAX notes when a file was used, to keep its bound. In a read-only folder, no program may count as worth keeping.
    jax.config.update("jax_compilation_cache_max_size", MAX_BYTES if is_kept else -1)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0 if is_kept else math.inf)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _remove_orphans(folder: Path) -> None:
    """Remove files of JAX's cache whose other half is missing, as after a full disk.

    JAX keeps a program in KEY-cache and the time of its last use in KEY-atime. As long as one program lacks its time,
    JAX stores no other (jax 0.10.1).
    """
    with contextlib.suppress(OSError, Timeout), FileLock(folder / ".lockfile", timeout=10):  # JAX's own lock
        files = {name: {path.name.removesuffix(name) for path in folder.glob(f"*{name}")} for name in HALVES}
        for name, other in (HALVES, HALVES[::-1]):
            for key in files[name] - files[other]:
                (folder / f"{key}{name}").unlink(missing_ok=True)


def leave_memory_to_torch(config: DictConfig) -> None:
    """Let JAX allocate GPU memory as needed if a network runs in PyTorch; by default it takes three quarters at once.

    Call it before JAX's first array. An existing value of XLA_PYTHON_CLIENT_PREALLOCATE stays.
    """
    if IN_TORCH.search(OmegaConf.to_yaml(config)):
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def check_platforms() -> None:
    """Raise a clear ValueError if JAX_PLATFORMS asks for a device that JAX does not find."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms in ("", "cpu"):
        return  # without importing JAX, which not all commands need
    import jax  # noqa: PLC0415

    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:
        raise ValueError(
            f"JAX_PLATFORMS={platforms}, and JAX finds no such device{f' ({error})' if str(error) else ''}: install "
            'JAX for it (pip install -U "jax[cuda13]" for an NVIDIA GPU), or unset JAX_PLATFORMS'
        ) from error
