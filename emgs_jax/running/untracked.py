"""Alarms about frames in a row that do not fit the map: nothing is fused while that lasts."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from emgs_jax.localization import REASONS
from emgs_jax.running.record import JOINED, NEW_SUBMAP, NOT_FOUND, RESTARTED, UNJOINED, FrameRecord

MANY_IN_A_ROW = 10  # single frames fail in every long sequence, so many together do not
UNTRACKED = ("degraded", "lost")
REMEDIES = dict(
    zip(
        REASONS,
        (
            "the prior gives nothing there; look at its confidence and mask, or leave these frames out "
            "(dataset.start, dataset.stop)",
            "take frames closer together (dataset.stride=…) or a wider submap (slam.submap.margin=…)",
            "the predictions differ from the map; take frames closer together (dataset.stride=…), or accept more "
            "(slam.localization.max_residual=…)",
            "take frames closer together (dataset.stride=…), or trust the prior's pose less "
            "(slam.localization.icp.prior_information=…, slam.localization.max_step=…)",
            "the images show too little, such as one wall; take frames with more of the scene in view",
        ),
        strict=True,
    )
) | {
    NOT_FOUND: "take images of the same place, or map it anew without map=",
    UNJOINED: "take images that lead from there to the rest, closer together (dataset.stride=…)",
}


def alarm(records: Sequence[FrameRecord]) -> str | None:
    """Return the message after a run's last record, if any: frames in a row untracked, tracked again, or new submap."""
    if not records:
        return None
    if records[-1].location == RESTARTED:
        return (
            f"{called(records[-1])}: relocalization fails, so the map restarts at the pose that the prior predicts; "
            "loop closures correct that pose"
        )
    if records[-1].location == NEW_SUBMAP:
        return (
            f"{called(records[-1])}: the prior continues in a world of its own, so a new map begins; it is joined with "
            "the other where a frame fits both, and dropped if none does"
        )
    if records[-1].location == JOINED:
        return f"{called(records[-1])} fits what was mapped before, and both are one map from here on"
    if records[-1].status in UNTRACKED:
        row = _last_row(records, MANY_IN_A_ROW + 1)
        if len(row) != MANY_IN_A_ROW:
            return None
        reason, _ = main_reason(row)
        return (
            f"{len(row)} frames in a row are not tracked, from {called(row[0])} on, and nothing is fused until one is: "
            f"{reason}; {REMEDIES[reason]}"
        )
    row = _last_row(records[:-1], len(records))
    if len(row) < MANY_IN_A_ROW:
        return None
    return f"{called(records[-1])} is the first that fits again after {len(row)} that did not"


def longest_row(records: Sequence[FrameRecord]) -> range:
    """Find the longest row of untracked frames, as positions in `records`; the first of equals, possibly empty."""
    longest, start = range(0), 0
    for place, record in enumerate(records):
        if record.status not in UNTRACKED:
            start = place + 1
        elif place + 1 - start > len(longest):
            longest = range(start, place + 1)
    return longest


def main_reason(records: Sequence[FrameRecord]) -> tuple[str, int]:
    """Return the most frequent reason of untracked frames, and its number of frames."""
    reasons = Counter(reason for record in records for reason in (record.reason or REASONS[0]).split("; "))
    return reasons.most_common(1)[0]


def called(record: FrameRecord) -> str:
    """Name a frame in messages: its file's name, or its number."""
    return f"frame {record.index}" if record.name is None else Path(record.name).name


def _last_row(records: Sequence[FrameRecord], most: int) -> Sequence[FrameRecord]:
    """Return the untracked frames at the end, `most` at most."""
    count = 0
    while count < min(most, len(records)) and records[-1 - count].status in UNTRACKED:
        count += 1
    return records[len(records) - count :]
