"""The last lines of a run, against counts that are known."""

import pytest

from emgs_jax.device.clock import Clock
from emgs_jax.localization import REASONS
from emgs_jax.mapping.records import MANY_IN_A_ROW, REMEDIES, FrameRecord
from emgs_jax.report.printout import frame_lines, last_words, time_words


def records(**statuses: int) -> list[FrameRecord]:
    return [FrameRecord(0, None, 0.0, status, reason=None) for status, count in statuses.items() for _ in range(count)]


def test_every_status_is_counted_and_few_bad_frames_need_no_advice():
    (line,) = frame_lines(records(tracked=18, degraded=1, lost=1, initialization=1), 3)
    assert line == "24 frames: 18 tracked, 1 degraded, 1 lost, 1 initialization, 3 skipped"


@pytest.mark.parametrize("reason", REASONS)
def test_where_many_are_not_tracked_the_most_frequent_reason_comes_with_what_to_do(reason):
    other = REASONS[REASONS.index(reason) - 1]
    bad = [FrameRecord(0, None, 0.0, "degraded", reason=text) for text in (f"{reason}; {other}", reason, other, reason)]
    _, advice = frame_lines([*records(tracked=20), *bad], 0)
    where = "4 in a row, from frame 0 to the end"
    assert advice == f"4 frames were not tracked ({where}), 3 of them because {reason}: {REMEDIES[reason]}"


def test_many_in_a_row_are_named_however_long_the_sequence_is():
    bad = [FrameRecord(0, f"room/{place}.png", 0.0, "degraded", REASONS[2]) for place in range(MANY_IN_A_ROW)]
    (_,) = frame_lines([*records(tracked=500), *bad[1:], *records(tracked=500)], 0)
    _, advice = frame_lines([*records(tracked=500), *bad, *records(tracked=500)], 0)
    assert advice.startswith("10 frames were not tracked (10 in a row, from 0.png to 9.png), 10 of them because")


def test_the_line_that_ends_a_run_says_how_many_frames_are_not_in_the_map_and_from_which_on():
    metrics = {f"frames/{key}": 0 for key in ("degraded", "lost")} | {"frames/tracked": 137, "frames/skipped": 2}
    metrics |= {"frames/initialization": 1, "frames/longest_untracked": 0, "frames/longest_untracked_from": None}
    metrics["submaps/unjoined_frames"] = 0
    assert last_words(metrics) == ""
    metrics |= {"frames/degraded": 258, "frames/lost": 2, "frames/longest_untracked": 250}
    metrics |= {"frames/longest_untracked_from": 138}
    said = "260 of 400 frames are degraded or lost, 250 in a row from frame 138 on"
    assert last_words(metrics) == f"{said}; "
    metrics["submaps/unjoined_frames"] = 40
    assert last_words(metrics) == f"{said}, 40 are in submaps that were never joined with the map; "


def test_the_seconds_of_a_run_are_those_of_all_its_phases():
    clock = Clock()
    clock.phases |= {"predict": 160.0, "map": 29.6, "raw_prior": 0.4}
    clock.compile_seconds = 12.34
    said = "predict 160.0, map 29.6, raw_prior 0.4; of all that compilation 12.3"
    assert time_words(clock, 40) == f"190.0 s, 4.75 s a frame: {said}"


def test_a_remedy_names_keys_that_there_are():
    from emgs_jax.config.configure import compose, keys_of

    known = keys_of(compose())
    words = " ".join(REMEDIES.values()).replace("(", " ").replace(")", " ").replace(",", " ").split()
    keys = {word.removesuffix("=…") for word in words if word.startswith(("slam.", "dataset."))}
    assert len(keys) > 5 and keys <= known


def test_what_moves_is_said():
    shares = {"a/0.png": 0.0, "a/1.png": 0.2, "a/2.png": 0.004}
    given = [FrameRecord(0, name, 0.0, "tracked", moving=share) for name, share in shares.items()]
    _, said = frame_lines(given, 0)
    assert said.startswith("in 1 frames something moves, most of it in 1.png (20 % of the pixels)")


def test_points_that_no_map_can_hold_are_counted_in_the_last_words():
    given = [*records(tracked=2), FrameRecord(5, "a/sky.png", 0.0, "tracked", left_out=30)]
    _, said = frame_lines(given, 0)
    assert said.startswith("30 points of 1 frames, from sky.png on, were left out: ") and "1e+06 m" in said
