"""What a run may cost: executables, frames that are read, time beside the mapping; oracle: what JAX and the clock say.

The first run of a group: what it compiles the other files of the group find in memory.
"""

import contextlib
from collections import Counter
from types import SimpleNamespace

import jax
import jax.monitoring
import pytest
from jax.experimental.compilation_cache import compilation_cache
from listening import compiled
from tiny_run import NUM_FRAMES, compose, make_exact_run

import experiments.run
from emgs_jax.data.synthetic import Synthetic

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]


@contextlib.contextmanager
def counted():
    """How often JAX says what of its compilation cache inside the block."""
    events = Counter()
    hear = lambda event, **_: events.update([event.rsplit("/", 1)[-1]])  # noqa: E731
    jax.monitoring.register_event_listener(hear)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_listener(hear)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, shared_folder):
    """The same run with an empty compilation cache, and again without an executable in memory."""
    before, folder = jax.config.jax_compilation_cache_dir, tmp_path_factory.mktemp("cache")
    found, read = {}, Synthetic.__getitem__
    with pytest.MonkeyPatch.context() as patch:
        reads = Counter()
        patch.setattr(Synthetic, "__getitem__", lambda self, index: reads.update([index]) or read(self, index))
        jax.config.update("jax_compilation_cache_dir", str(folder))
        for name in ("cold", "warm"):
            jax.clear_caches()
            compilation_cache.reset_cache()
            reads.clear()
            out = tmp_path_factory.mktemp(name)
            with counted() as events, compiled() as names:
                metrics = experiments.run.run(compose("prior.level=0"), out)
            about = {"events": events, "reads": Counter(reads), "names": Counter(names)}
            found[name] = SimpleNamespace(folder=out, metrics=metrics, **about)
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()
    make_exact_run(shared_folder, found["cold"].folder)
    return SimpleNamespace(**found)


def test_a_warm_run_compiles_nothing_and_has_the_bits_of_a_cold_one(runs):
    assert runs.cold.events["cache_misses"] > 20 and runs.warm.events["cache_misses"] == 0
    for name in ("map.npz", "trajectory.txt", "map.ply", "points.ply", "mesh.ply", "text.npz"):
        assert (runs.warm.folder / name).read_bytes() == (runs.cold.folder / name).read_bytes(), name
    keys = {key for key in runs.cold.metrics if not key.startswith(("time/", "memory/"))}
    assert {key: runs.warm.metrics[key] for key in keys} == {key: runs.cold.metrics[key] for key in keys}


def test_a_run_makes_no_more_executables_than_it_did(runs):
    """33 when this was written: two thirds are kept functions, the rest an operation that the host asks for each.

    Two more fill the covariances of a prior that does not say how sure it is of its poses, and two find what moves and
    keep the frame to look for that in the next. One fuses the sheets of surfaces when the run ends.

    A further one costs .05 to .5 s of every first run, so who adds some says why here.
    """
    assert runs.cold.events["compile_requests_use_cache"] <= 39


def test_nothing_is_compiled_twice(runs):
    """What is prepared is what a step takes: the coarse pose was compiled again for a type that differed.

    The host puts one pose and those of all frames on the device; JAX's own operations on arrays are small.
    """
    twice = {name for name, count in runs.cold.names.items() if count > 1}
    assert twice <= {"_poses", "true_divide", "stage", "convert_element_type"}


def test_a_frame_is_read_once(runs):
    """Once: a frame of the built-in room is ray-cast each time, one of a data set decoded."""
    for run in (runs.cold, runs.warm):
        assert run.reads == dict.fromkeys(range(NUM_FRAMES), 1)


def test_most_of_the_time_goes_into_the_mapping(runs):
    """All else together took 14 % of a cold run and 26 % of a warm one; a phase that grows with the square shows."""
    seconds = runs.cold.metrics
    rest = sum(seconds[f"time/{name}_seconds"] for name in ("setup", "raw_prior", "densify", "export", "evaluate"))
    assert rest < 0.4 * seconds["time/total_seconds"]
