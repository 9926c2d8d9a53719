"""The last lines of a run, against counts that are known."""

import pytest

from emgs_jax.localization import REASONS
from emgs_jax.report.printout import REMEDIES, frame_lines
from emgs_jax.running.record import FrameRecord


def records(**statuses: int) -> list[FrameRecord]:
    return [FrameRecord(0, "", 0.0, status, reason=None) for status, count in statuses.items() for _ in range(count)]


def test_every_status_is_counted_and_few_bad_frames_need_no_advice():
    (line,) = frame_lines(records(tracked=18, degraded=1, lost=1, initialization=1), 3)
    assert line == "24 frames: 18 tracked, 1 degraded, 1 lost, 1 initialization, 3 skipped"


@pytest.mark.parametrize("reason", REASONS)
def test_where_many_are_not_tracked_the_most_frequent_reason_comes_with_what_to_do(reason):
    other = REASONS[REASONS.index(reason) - 1]
    bad = [FrameRecord(0, "", 0.0, "degraded", reason=text) for text in (f"{reason}; {other}", reason, other, reason)]
    _, advice = frame_lines([*records(tracked=20), *bad], 0)
    assert advice == f"4 frames were not tracked, 3 of them because {reason}: {REMEDIES[reason]}"


def test_a_remedy_names_keys_that_there_are():
    from emgs_jax.running.configure import compose, keys_of

    known = keys_of(compose())
    words = " ".join(REMEDIES.values()).replace("(", " ").replace(")", " ").replace(",", " ").split()
    keys = {word.removesuffix("=…") for word in words if word.startswith(("slam.", "dataset."))}
    assert len(keys) > 5 and keys <= known
