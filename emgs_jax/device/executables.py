"""Executables of the processes before this one, loaded without tracing and lowering, which cost ten times as much.

JAX's own cache finds an executable by its program, which has to be made first: some seven CPU seconds more for every
run. Here it is found by what its program is made from: the function and all that it names, as they are in memory
(`fingerprint`), versions, machine, settings, shapes and static values. What cannot be told so is JAX's to keep. The
files are in JAX's folder (`use_compilation_cache`), whose bound is theirs, too; without a folder nothing is kept.

An entry says which program it stands for and what comes out of it; the program's executable is a file of its own, so
that after a change of the source whatever still is the same program is not compiled again. Loading one runs machine
code and, inside JAX, a pickle: as JAX's cache the folder has to be the user's own (SECURITY.md).
"""

import contextlib
import hashlib
import json
import os
import platform
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.monitoring
from jax.experimental import serialize_executable

from emgs_jax.device.executable_files import described, read, rebuilt, remove, write
from emgs_jax.device.fingerprint import PACKAGES, fingerprint

FORMAT = 3  # of entries; 2 were found by the text of source files
# By what XLA decides how many threads an executable has, beside the CPUs that the process may use.
THREADS = ("XLA_FLAGS", "PJRT_NPROC", "NPROC")
COMPILED = "/jax/core/compile/backend_compile_duration"
LOOKED, FOUND = (f"/jax/compilation_cache/{name}" for name in ("compile_requests_use_cache", "cache_hits"))
# Defaults, but executables that are asked for with one of them are others to JAX's cache: what was taken from there
# cannot be kept again, as on CPUs it has lost its functions (jaxlib 0.10.1). The second is for a file that was damaged.
_OPTIONS = {"xla_embed_ir_in_executable": False}, {"xla_dump_hlo_as_text": False}, {"xla_dump_hlo_as_proto": False}
_loaded: dict[tuple, Callable] = {}
_seen: dict[tuple, tuple] = {}  # what this process has traced: a function and classes, and their fingerprint
_thread = threading.local()  # `heard`: what JAX says of its cache
_making: dict[int, str] = {}  # thread -> the function that it compiles
_counted = [0, 0]  # of the stages that are made side by side: those that are done, and all


def call(function: Callable, *arguments: Any) -> Any:
    """Compute `function(*arguments)` by an executable that is kept on disk.

    Args:
        function: made by `eqx.filter_jit` from a function of this package.
        *arguments: of which arrays are traced; where they are traced already, or on another device, nothing is kept.
    """
    return (ready(function, *arguments) or function)(*arguments)


def stored(function: Callable) -> Callable:
    """`eqx.filter_jit` whose executables are kept."""
    return partial(call, eqx.filter_jit(function))


def ready(function: Callable, *arguments: Any) -> Callable | None:
    """The executable of a function for arguments like these, loaded or compiled; None where nothing is kept."""
    leaves, tree = jax.tree.flatten(arguments)
    if _written(function, tree) is None or _folder() is None or not _are_plain(leaves):
        return None
    about = tuple(_about(leaf) for leaf in leaves)
    key = function, tree, about, jax.config.jax_default_matmul_precision, jax.config.jax_enable_x64
    if key not in _loaded:
        _loaded[key] = _made(function, arguments, _digest(function, tree, about))
    return _loaded[key]


@contextlib.contextmanager
def making(function: Callable) -> Iterator[None]:
    """Say inside that a function is compiled in this thread."""
    thread = threading.get_ident()
    _making[thread] = function.__wrapped__.__name__.strip("_")
    try:
        yield
    finally:
        _making.pop(thread, None)


def make_all(make: Callable, calls: Sequence[tuple[Callable, tuple]]) -> None:
    """`make(function, arguments)` for all of them, on as many cores as there are."""

    def count(call: tuple[Callable, tuple]) -> None:
        make(*call)
        _counted[0] += 1

    _counted[:] = 0, len(calls)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            list(threads.map(count, calls))
    finally:
        _counted[:] = 0, 0


def compiling() -> str:
    """What is compiled now, in words; "" where nothing is."""
    names, (done, whole) = ", ".join(sorted({*_making.values()})), _counted
    if not names:
        return ""
    return f"compiling stage {min(done + 1, whole)} of {whole}, once: {names}" if whole else f"compiling {names}, once"


def outputs(function: Callable, *arguments: Any) -> Any:
    """`eqx.filter_eval_shape`, which traces the function, or what is kept of that."""
    leaves, tree = jax.tree.flatten(arguments)
    is_kept = _written(function, tree) is not None and _folder() is not None
    entry = _entry(_digest(function, tree, tuple(map(_about, leaves)))) if is_kept else None
    if entry is not None:
        return rebuilt(entry["outputs"])
    with making(function):
        return eqx.filter_eval_shape(function, *arguments)


def forget() -> None:
    """Drop what this process has loaded and compiled here, as `jax.clear_caches` does for all else."""
    _loaded.clear()
    _seen.clear()


def forget_replaced() -> None:
    """Drop everything that is compiled where a function has been replaced since it was traced.

    JAX would go on with what the function was when it was first called with arrays of these shapes.
    """
    if any(fingerprint(*things) != before for things, before in dict(list(_seen.values())).items()):
        forget()
        jax.clear_caches()


def _written(function: Callable, tree: Any) -> str | None:
    """Fingerprint of a function and of the classes of its arguments, as they were when it was first called with such.

    None where something that it names cannot be told.
    """
    key = function, tree
    if key not in _seen:
        things = function.__wrapped__, *dict.fromkeys(_classes(tree))
        _seen[key] = things, fingerprint(*things)
    return _seen[key][1]


def _classes(tree: Any) -> Iterator[type]:
    if tree.node_data() is not None:
        yield tree.node_data()[0]
    for child in tree.children():
        yield from _classes(child)


def _folder() -> Path | None:
    folder = jax.config.jax_compilation_cache_dir if jax.config.jax_enable_compilation_cache else None
    return None if folder is None else Path(folder)


def _are_plain(leaves: list) -> bool:
    """No tracers, and all arrays on the device on which all else is."""
    device = {jax.devices()[0]}
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return False
    return all(leaf.devices() == device for leaf in leaves if isinstance(leaf, jax.Array))


def _about(leaf: Any) -> Any:
    return (leaf.shape, leaf.dtype.name, leaf.weak_type) if isinstance(leaf, jax.Array) else leaf


def _made(function: Callable, arguments: tuple, digest: str) -> Callable:
    """The executable of an entry, or of a new one where it is missing, damaged or refused."""
    entry = _entry(digest)
    found = None if entry is None else _runnable(entry["program"], function, arguments, rebuilt(entry["outputs"]))
    if found is not None:
        return found
    with making(function):
        return _compile(function, arguments, digest)


def _compile(function: Callable, arguments: tuple, digest: str) -> Callable:
    """The executable of a new entry: that of the same program in another entry, or compiled and kept."""
    lowered = function.lower(*arguments)
    outputs, text = eqx.filter_eval_shape(function, *arguments), lowered.as_text()
    shapes = [_about(leaf) for leaf in _arrays(arguments)]  # of those it does not take, too: each call checks them
    program = _hash(*_machine(), text, *_used(lowered, digest), shapes)
    found = _runnable(program, function, arguments, outputs)
    if found is None:
        found, is_new = _compiled(lowered)
        if not is_new or "callback" in text:  # which knows where it is in this process
            return found
        write(_folder(), program, serialize_executable.serialize(found.compiled)[0])
    with contextlib.suppress(TypeError):  # something comes out that has no description
        write(_folder(), digest, json.dumps({"program": program, "outputs": described(outputs)}).encode())
    return found


def _used(lowered: Any, digest: str) -> list[object]:
    """Numbers of the arguments that a program takes, which its text does not tell; else it is shared by none."""
    try:
        return sorted(lowered.lowered._lowering.compile_args["kept_var_idx"])
    except (AttributeError, KeyError):
        return [digest]


def _compiled(lowered: Any) -> tuple[Callable, bool]:
    """An executable, and whether it was made here: JAX looked into its cache, where it was not.

    What JAX still has in memory may be from its cache, too, and of that it says nothing.
    """
    _listen()
    is_new = False
    for options in _OPTIONS:
        _thread.heard = set()
        found = lowered.compile(options)
        is_new = LOOKED in _thread.heard and FOUND not in _thread.heard
        if is_new:
            break
    return found, is_new


def _runnable(program: str, function: Callable, arguments: tuple, outputs: Any) -> Callable | None:
    """The kept executable of a program, as that function of such arguments; told as JAX tells what its cache gives."""
    folder, begin = _folder(), time.perf_counter()
    payload = read(folder, program)
    if payload is None:
        return None
    leaves, structure = jax.tree.flatten(outputs)
    num_arrays = sum(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves)
    inputs = jax.tree.structure((tuple(_arrays(arguments)), {}))
    marked = jax.tree.structure((0, *range(num_arrays)))  # Equinox returns a number before all else
    _prepare_lapack()
    try:
        executable = serialize_executable.deserialize_and_load(
            payload, inputs, marked, execution_devices=jax.devices()[:1]
        )
    except Exception as error:  # whatever XLA dislikes
        remove(folder, program, error)
        return None
    name = function.__wrapped__.__name__
    jax.monitoring.record_event_duration_secs(COMPILED, time.perf_counter() - begin, fun_name=name)
    is_sound: bool | None = None  # what its first call tells: one that has lost its functions loads as any other

    def run(*arguments: Any) -> Any:
        nonlocal is_sound
        if is_sound is False:
            return function(*arguments)
        try:
            _, *found = executable(*_arrays(arguments))
            if not is_sound:
                jax.block_until_ready(found)
                is_sound = True
        except jax.errors.JaxRuntimeError as error:
            if is_sound:
                raise
            is_sound = False
            remove(folder, program, error)
            return function(*arguments)
        arrays = iter(found)
        filled = [next(arrays) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf for leaf in leaves]
        return jax.tree.unflatten(structure, filled)

    return run


def _arrays(arguments: tuple) -> list[jax.Array]:
    return [leaf for leaf in jax.tree.leaves(arguments) if isinstance(leaf, jax.Array)]


@cache
def _prepare_lapack() -> None:
    """Lowering tells executables where SciPy's LAPACK is; one that is loaded without would end the process."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), "float32"))


@cache
def _listen() -> None:
    """Hear in each thread what JAX says of its cache."""

    def hear(event: str, **_: Any) -> None:
        _thread.heard = {event, *getattr(_thread, "heard", ())}

    jax.monitoring.register_event_listener(hear)


def _digest(function: Callable, tree: Any, about: tuple) -> str:
    """Of all that a program is made from."""
    inside = {name: getattr(jax.config, name, value) for name, value in jax.config.values.items()}  # of `with`
    settings = [f"{name}={inside[name]}" for name in sorted(inside) if "cache" not in name]
    return _hash(FORMAT, *_machine(), *settings, _written(function, tree), tree, about)


def _hash(*parts: object) -> str:
    return "emgs-" + hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()


@cache
def _machine() -> tuple[str, ...]:
    """Describe the machine and versions that an executable is for; the number of threads decides how sums are split."""
    may_use = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    device = jax.devices()[0]
    cpu = Path("/proc/cpuinfo")
    text = cpu.read_text(encoding="utf-8") if cpu.exists() else ""
    features = sorted(set(re.findall(r"^(?:flags|Features)\s*:.*", text, re.M)))
    versions = [f"{name} {version(name)}" for name in PACKAGES]
    about = platform.python_version(), platform.machine(), len(may_use), *map(os.environ.get, THREADS)
    return *map(str, about), *versions, *features, device.device_kind, device.client.platform_version


def _entry(digest: str) -> dict[str, Any] | None:
    data = read(_folder(), digest)
    return None if data is None else json.loads(data)
