"""A bar moves while nothing is counted, and says what goes on; oracle: what stands in its stream."""

import io
import time

import pytest

from emgs_jax.io import bar
from emgs_jax.io.bar import Bar


def until(holds):
    end = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def stream(monkeypatch):
    monkeypatch.setattr(bar, "SECONDS", (0.01, 0.01))
    return io.StringIO()


def test_a_bar_says_what_goes_on_until_it_has_ended_and_leaves_what_others_say(stream):
    words = ["compiling refine, once"]
    with Bar(total=2, file=stream, doing=lambda: words[0]) as shown:
        until(lambda: stream.getvalue().count(words[0]) > 2)
        words[0] = ""
        until(lambda: shown.postfix == "")
        shown.set_postfix_str("tracked")
        before = stream.getvalue().count("tracked")
        until(lambda: stream.getvalue().count("tracked") > before + 2)
    said = stream.getvalue()
    time.sleep(0.1)
    assert stream.getvalue() == said, "a bar that is closed is silent"


def test_a_bar_that_is_turned_off_says_nothing(stream):
    with Bar(total=2, file=stream, disable=True, doing=lambda: "words"):
        time.sleep(0.1)
    assert stream.getvalue() == ""
