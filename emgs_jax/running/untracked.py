"""Frames in a row that do not fit the map: nothing is fused while that lasts, so it is said at once."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from emgs_jax.localization import REASONS
from emgs_jax.running.record import ANEW, JOINED, NOT_FOUND, SEGMENT, UNJOINED, FrameRecord

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
    if records[-1].location == ANEW:
        return (
            f"{called(records[-1])}: the camera is found nowhere, so the map begins anew where the prior puts it; "
            "loops join the parts where they meet"
        )
    if records[-1].location == SEGMENT:
        return (
            f"{called(records[-1])}: the prior goes on in a frame of its own, so a new map begins; it is joined with "
            "what there is where a frame fits both, and left out if none does"
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
    """Places in `records` of the most frames in a row that are not tracked, the first of equals; may be empty."""
    longest, start = range(0), 0
    for place, record in enumerate(records):
        if record.status not in UNTRACKED:
            start = place + 1
        elif place + 1 - start > len(longest):
            longest = range(start, place + 1)
    return longest


def main_reason(records: Sequence[FrameRecord]) -> tuple[str, int]:
    """The most frequent reason of frames that are not tracked, and of how many it is one."""
    reasons = Counter(reason for record in records for reason in (record.reason or REASONS[0]).split("; "))
    return reasons.most_common(1)[0]


def called(record: FrameRecord) -> str:
    """Name a frame in messages: its file's name, or its number."""
    return f"frame {record.index}" if record.name is None else Path(record.name).name


def _last_row(records: Sequence[FrameRecord], most: int) -> Sequence[FrameRecord]:
    """The frames at the end that are not tracked, at most so many."""
    count = 0
    while count < min(most, len(records)) and records[-1 - count].status in UNTRACKED:
        count += 1
    return records[len(records) - count :]
