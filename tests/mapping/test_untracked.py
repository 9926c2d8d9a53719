"""Frames in a row that do not fit; oracle: rows of statuses written by hand."""

import itertools
import random
from dataclasses import replace

import pytest
from tqdm import tqdm

from emgs_jax.localization import REASONS
from emgs_jax.mapping.records import MANY_IN_A_ROW, REMEDIES, FrameRecord, alarm, longest_row, show_records

STATUS = {"t": "tracked", "d": "degraded", "l": "lost", "i": "initialization"}


def records(letters: str) -> list[FrameRecord]:
    return [
        FrameRecord(place, f"images/{place}.jpg", 0.0, STATUS[letter], reason=REASONS[2] if letter in "dl" else None)
        for place, letter in enumerate(letters)
    ]


def said(letters: str) -> dict[int, str]:
    """What is said while a run goes by, by the frame at which it is."""
    rows = records(letters)
    return {place: text for place in range(len(rows)) if (text := alarm(rows[: place + 1])) is not None}


def test_many_frames_in_a_row_are_said_once_at_once_and_so_is_their_end():
    found = said("ittt" + "d" * 13 + "lll" + "tt")
    assert list(found) == [4 + MANY_IN_A_ROW - 1, 20]
    assert found[13] == (
        f"10 frames in a row are not tracked, from 4.jpg on, and nothing is fused until one is: {REASONS[2]}; "
        f"{REMEDIES[REASONS[2]]}"
    )
    assert found[20] == "20.jpg is the first that fits again after 16 that did not"


@pytest.mark.parametrize("letters", ["", "ittt", "i" + "d" * (MANY_IN_A_ROW - 1) + "t", "i" + "dddddt" * 9])
def test_a_few_frames_that_do_not_fit_are_no_alarm(letters):
    assert said(letters) == {}


def test_frames_before_there_is_a_map_count_too():
    assert list(said("l" * 12 + "i")) == [MANY_IN_A_ROW - 1, 12]


@pytest.mark.parametrize(
    ("location", "words"),
    [("restarted", "6.jpg: relocalization fails"), ("new_submap", "a new map begins"), ("joined", "both are one map")],
)
def test_where_a_map_restarts_or_begins_and_where_two_are_joined_is_said_once(location, words):
    rows = records("it" + "l" * 4 + "ittt")
    rows[6] = replace(rows[6], location=location)
    texts = [alarm(rows[: place + 1]) for place in range(len(rows))]
    assert [place for place, text in enumerate(texts) if text] == [6] and words in texts[6]


@pytest.mark.parametrize("seed", range(20))
def test_the_longest_row_is_that_of_a_search_over_all_of_them(seed):
    letters = "".join(random.Random(seed).choices("tdl", k=12))
    rows = [
        range(start, stop) for start, stop in itertools.combinations(range(13), 2) if "t" not in letters[start:stop]
    ]
    assert longest_row(records(letters)) == max(rows, key=len, default=range(0))


def test_the_console_gets_the_line_and_a_run_without_a_bar_stays_silent(capsys):
    rows = records("i" + "d" * MANY_IN_A_ROW)
    for is_silent in (True, False):
        show_records(tqdm(disable=is_silent), rows, 1)
        assert ("in a row are not tracked" in "".join(capsys.readouterr())) is not is_silent
