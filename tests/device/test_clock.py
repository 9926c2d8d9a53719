"""Phases and compilation against spans that are known."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.device.clock import Clock, peak_memory_mb


def test_spans_within_spans_are_counted_once():
    clock = Clock()
    for begin, end in ((1.0, 2.0), (3.0, 4.0), (0.5, 4.5), (6.0, 7.0), (6.5, 8.0)):
        clock.add_span(begin, end)
    assert clock.compile_seconds == pytest.approx(4.0 + 2.0)


def test_only_a_new_shape_is_a_compilation():
    function = jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x).T)
    x, y = jnp.asarray(np.ones((3, 5), np.float32)), jnp.asarray(np.ones((4, 5), np.float32))
    seconds = []
    with Clock().watching() as clock:
        for value in (x, x, y):
            before = clock.compile_seconds
            function(value).block_until_ready()
            seconds.append(clock.compile_seconds - before)
    assert seconds[0] > 0 and seconds[1] == 0 and seconds[2] > 0
    after = clock.compile_seconds
    function(jnp.ones((6, 5))).block_until_ready()
    assert clock.compile_seconds == after, "a clock that no longer watches must not hear"


@pytest.fixture
def hands(monkeypatch):
    """The hands of the clock: what a test adds to `now` has passed."""
    hands = SimpleNamespace(now=100.0)
    monkeypatch.setattr("time.perf_counter", lambda: hands.now)
    return hands


def test_a_phase_counts_its_seconds_also_when_it_fails(hands):
    clock = Clock()
    with pytest.raises(RuntimeError), clock.phase("work"):
        hands.now += 2.0
        raise RuntimeError
    hands.now += 5.0
    with clock.phase("work"):
        hands.now += 3.0
    assert clock.phases == {"work": 5.0} and clock.total_seconds == 10.0


def test_a_phase_inside_another_is_counted_once(hands):
    clock = Clock()
    with clock.phase("outer"):
        for _ in range(2):
            hands.now += 1.0
            with clock.phase("inner"):
                hands.now += 4.0
    assert clock.phases == {"inner": 8.0, "outer": 2.0}


def test_what_it_takes_to_make_items_is_counted_and_what_is_done_with_them_is_not(hands):
    def slow():
        for number in range(3):
            hands.now += 2.0
            yield number

    clock, seen = Clock(), []
    for item in clock.each("make", slow()):
        hands.now += 30.0
        seen.append(item)
    assert seen == [0, 1, 2] and clock.phases == {"make": 6.0}


def test_the_peak_memory_contains_an_array_that_was_touched():
    before = peak_memory_mb()
    block = np.ones(64 * 2**20, np.uint8)
    assert peak_memory_mb() >= max(before, 64) and block[-1] == 1
