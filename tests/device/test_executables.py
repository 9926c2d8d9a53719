"""Kept executables: the same bits as those that are compiled, without a trace; never a reason to fail."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from jax._src.lru_cache import LRUCache
from listening import compiled
from scene import (
    first_window,
    observe_room,
    path_pose,
    predict_room,
    random_gaussians,
    random_observation,
    slam_config,
    stack_poses,
)

from emgs_jax import em
from emgs_jax.device import executable_files, executables
from emgs_jax.device.executables import call, compiling, make_all, outputs, ready, stored
from emgs_jax.mapping.capacity import _prepare, start
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.executable import calling
from emgs_jax.ops.pytree import stack
from emgs_jax.slam import step

pytestmark = pytest.mark.slow

TRACES = []
ROOM = 3.0  # a number of the module, as thresholds of a stage that are no config


def looked_at(points, camera, names):
    """What comes out is a tree of modules with static fields, nothings, numbers and tuples."""
    TRACES.append(1)
    turned = jnp.linalg.svd(points.T @ points)[0] * ROOM
    pose = jaxlie.SE3(jnp.concatenate([jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.mean(points, axis=0)]))
    return (pose, [camera, None]), (turned, len(names)), jnp.asarray(1.0)


function = eqx.filter_jit(looked_at)
ARGUMENTS = np.arange(12, dtype=np.float32).reshape(4, 3), Camera([20.0, 23.0], [14.5, 12.25], 32, 24), ("a", "b")


def arguments(points=ARGUMENTS[0]):
    return jnp.asarray(points), *ARGUMENTS[1:]


@pytest.fixture
def folder(tmp_path):
    """An empty folder."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    as_a_new_process()
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def as_a_new_process():
    """Nothing in memory."""
    executables.forget()
    jax.clear_caches()
    TRACES.clear()


def entries(folder):
    return sorted(path for path in folder.glob("emgs-*-cache"))


def assert_same(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other, strict=isinstance(one, jax.Array))


def test_what_was_kept_gives_the_same_bits_in_the_same_structure_and_traces_nothing(folder):
    expected = function(*arguments())
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)  # compiled and kept
    assert TRACES and len(entries(folder)) == 2  # an entry and its program
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)
    shapes = outputs(function, *arguments())
    assert jax.tree.structure(shapes) == jax.tree.structure(expected) and not TRACES
    assert_same(stored(looked_at)(*arguments()), expected)


def told(points):
    TRACES.append(compiling())
    return 2 * points


@pytest.mark.parametrize("is_kept", [True, False])
def test_who_waits_is_told_what_is_compiled_and_how_many_stages_there_are(folder, is_kept):
    jax.config.update("jax_compilation_cache_dir", str(folder) if is_kept else None)
    stages = [(eqx.filter_jit(told), (jnp.ones(size),)) for size in (2, 3)]
    make_all(lambda *stage: _prepare(*stage), stages)
    assert {said.partition(" of ")[2] for said in TRACES} == {"2, once: told"} and compiling() == ""
    call(eqx.filter_jit(told), jnp.ones(4))
    assert TRACES[-1] == ("compiling told, once" if is_kept else "")


@pytest.mark.parametrize("change", ["shape", "static", "number", "precision", "weak type"])
def test_what_makes_another_program_is_another_entry(folder, monkeypatch, change):
    call(function, *arguments())
    as_a_new_process()
    points, camera, names = arguments()
    if change == "number":
        monkeypatch.setattr(sys.modules[__name__], "ROOM", 4.0)
    given = {
        "shape": (points[:3], camera, names),
        "static": (points, camera, ("a",)),
        "weak type": (points, eqx.tree_at(lambda c: c.focal, camera, jax.lax.full((2,), 20.0)), names),
    }.get(change, (points, camera, names))
    with jax.default_matmul_precision("float32" if change == "precision" else None):
        expected = function(*given)
        as_a_new_process()
        assert_same(call(function, *given), expected)
    assert TRACES


def test_what_else_makes_the_same_program_compiles_nothing_again(folder, monkeypatch):
    expected = call(function, *arguments())
    as_a_new_process()
    monkeypatch.setattr(sys.modules[__name__], "ROOM", int(ROOM))
    with compiled() as names:  # a run tells of it as of one that was compiled
        assert_same(call(function, *arguments()), expected)
    assert names[-1] == "looked_at"
    programs = [path for path in entries(folder) if path.stat().st_size > 1000]
    assert TRACES and len(programs) == 1 and len(entries(folder)) == 3


def either(first, second):
    return 2.0 * (first if ROOM == 3.0 else second)


def test_programs_that_differ_in_which_argument_they_take_are_two(folder, monkeypatch):
    one, other = jnp.ones(3), jnp.zeros(3)
    np.testing.assert_array_equal(call(eqx.filter_jit(either), one, other), 2.0 * one)
    as_a_new_process()
    monkeypatch.setattr(sys.modules[__name__], "ROOM", 4.0)
    np.testing.assert_array_equal(call(eqx.filter_jit(either), one, other), 2.0 * other)
    as_a_new_process()
    np.testing.assert_array_equal(call(eqx.filter_jit(either), one, other), 2.0 * other)


def explain(step):
    """A small E-step through the store: how many points are fused."""
    found = call(eqx.filter_jit(step), random_gaussians(8), random_observation(8), jnp.zeros((8, 3)), slam_config().em)
    return int(jnp.sum(found[0].is_fused))


def nothing_is_fused(*given, stage=em._explain):
    shares, fused, best = stage(*given)
    return 0 * shares, fused & False, best


@pytest.mark.parametrize("is_warm", [True, False])
def test_a_stage_that_is_replaced_is_what_runs_and_not_what_others_get(folder, monkeypatch, is_warm):
    """The store was keyed by source files: it ran the old stage, or served the new one to every later run."""
    expected = explain(em.e_step) if is_warm else None
    with monkeypatch.context() as patch:
        patch.setattr(em, "_explain", nothing_is_fused)
        executables.forget_replaced()  # as each run begins
        assert explain(em.e_step) == 0
        as_a_new_process()
        assert explain(em.e_step) == 0
    executables.forget_replaced()
    assert explain(em.e_step) == (expected or explain(em.e_step)) > 0


def first_of(first, second):
    return 2 * first


def test_an_argument_that_a_program_does_not_take_may_have_another_shape(folder):
    """Features that nobody renders: a run without any ended where one with some had drawn its map before."""
    function = eqx.filter_jit(first_of)
    for width in (16, 0):
        given = jnp.arange(3.0), jnp.zeros((5, width))
        np.testing.assert_array_equal(call(function, *given), [0, 2, 4])
        as_a_new_process()
        np.testing.assert_array_equal(call(function, *given), [0, 2, 4])


@pytest.mark.parametrize("harm", [b"", b"x" * 100, "cut", "flipped"])
def test_a_damaged_file_is_compiled_anew_and_replaced(folder, harm, capsys):
    expected = call(function, *arguments())
    for path in entries(folder):
        data = path.read_bytes()
        path.write_bytes({"cut": data[:-9], "flipped": data[:-1] + bytes([data[-1] ^ 1])}.get(harm, harm))
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)
    assert capsys.readouterr().err.count("warning: an executable is compiled anew") == 2
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)
    assert not TRACES and capsys.readouterr().err == ""


def test_a_class_of_others_is_not_made_and_what_xla_refuses_is_compiled(folder, capsys):
    expected = call(function, *arguments())
    (entry,) = (path for path in entries(folder) if path.stat().st_size < 1000)
    (program,) = set(entries(folder)) - {entry}
    with pytest.raises(ValueError, match="subprocess is not of this package"):
        executable_files.rebuilt({"class": "subprocess:Popen", "fields": {}})
    executable_files.write(folder, program.name.removesuffix("-cache"), b"sound, but no executable")
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)
    assert str(program) in capsys.readouterr().err


def test_what_jax_took_from_its_cache_is_not_kept_when_it_is_asked_again(folder):
    """It has lost its functions; JAX has it in memory then, and does not say where it is from."""
    for _ in executables._OPTIONS:  # now JAX's cache has it with each of them
        as_a_new_process()
        expected = call(function, *arguments())
        for path in entries(folder):
            path.unlink()
    as_a_new_process()
    for _ in range(2):
        assert_same(call(function, *arguments()), expected)
        executables.forget()
    assert not [path for path in entries(folder) if path.stat().st_size > 1000]


def test_an_executable_that_fails_when_it_is_first_called_is_compiled_anew(folder, monkeypatch, capsys):
    expected = call(function, *arguments())
    as_a_new_process()

    def without_functions(*_, **__):
        def failing(*_):
            raise jax.errors.JaxRuntimeError("NOT_FOUND: Function broadcast_in_dim.1_kernel not found")

        return failing

    with monkeypatch.context() as patch:
        patch.setattr(executables.serialize_executable, "deserialize_and_load", without_functions)
        for _ in range(2):
            assert_same(call(function, *arguments()), expected)
    assert capsys.readouterr().err.count("kernel not found") == 1
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)


def test_inside_jit_and_vmap_and_without_a_folder_functions_are_called_as_they_are(folder):
    points, camera, names = arguments()
    one = lambda points: call(function, points, camera, names)[2]  # noqa: E731
    jax.jit(one)(points), jax.vmap(one)(jnp.stack([points, points]))
    assert not entries(folder)
    jax.config.update("jax_compilation_cache_dir", None)
    assert ready(function, points, camera, names) is None
    assert_same(call(function, points, camera, names), function(points, camera, names))


def test_a_folder_that_cannot_be_written_is_no_failure(folder):
    expected = function(*arguments())
    jax.config.update("jax_compilation_cache_dir", str(folder / "file" / "below"))
    (folder / "file").touch()
    as_a_new_process()
    assert_same(call(function, *arguments()), expected)


def test_a_folder_that_can_only_be_read_keeps_what_is_in_it(folder, monkeypatch, capsys):
    """A time of use that could not be written counted as damage, and every entry was removed."""
    executable_files.write(folder, "emgs-x", b"program")
    monkeypatch.setattr(Path, "write_bytes", mock.Mock(side_effect=OSError(errno.EDQUOT, "Disk quota exceeded")))
    assert executable_files.read(folder, "emgs-x") == b"program" and len(entries(folder)) == 1
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("what", ["cpus", "PJRT_NPROC", "NPROC", "XLA_FLAGS"])
def test_the_number_of_threads_is_part_of_the_key(monkeypatch, what):
    """XLA splits loops by the CPUs that the process may use (taskset), not by those that there are."""
    machine = executables._machine.__wrapped__
    before = machine()
    if what == "cpus":
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(77))
    else:
        monkeypatch.setenv(what, "77")
    assert machine() != before


def test_the_bound_of_jaxs_cache_holds_for_kept_executables_and_removes_what_was_not_used_for_longest(folder):
    executable_files.write(folder, "emgs-old", b"old")
    executable_files.write(folder, "emgs-new", b"new")
    assert executable_files.read(folder, "emgs-old") == b"old"  # and so it is the one used last
    size = sum(path.stat().st_size for path in entries(folder))
    LRUCache(str(folder), max_size=size).put("other", b"x")
    assert [path.name for path in entries(folder)] == ["emgs-old-cache"]


def test_a_new_process_that_lowers_nothing_finds_lapack(tmp_path):
    """It ended with a segmentation fault: lowering is what tells LAPACK's functions where SciPy has them."""
    program = "\n".join(
        (
            "import jax, jax.numpy as jnp, equinox as eqx",
            "from emgs_jax.device.executables import call",
            "print(call(eqx.filter_jit(lambda x: jnp.linalg.svd(x)[1]), jnp.asarray([[3.0, 0.0], [0.0, 4.0]])))",
        )
    )
    variables = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    for _ in range(2):
        ended = subprocess.run([sys.executable, "-c", program], env=variables, capture_output=True, text=True)
        assert (ended.returncode, ended.stdout) == (0, "[4. 3.]\n"), ended.stderr
    assert len(entries(tmp_path)) == 2


@pytest.mark.weekly  # the whole step is compiled twice
def test_a_step_of_kept_executables_has_the_bits_of_a_step_without(folder, camera):
    config = slam_config("slam.initialization=merged")
    poses = [path_pose(i) for i in range(3)]
    first = first_window(stack([observe_room(T, camera, num_features=2) for T in poses]), stack_poses(poses))
    state, config = start(first, camera, config)
    given = predict_room(3, camera, num_features=2), camera, config
    expected = step(state, *given)
    as_a_new_process()
    for _ in range(2):  # compiled, and loaded
        with calling(call):
            assert_same(step(state, *given), expected)
        as_a_new_process()
