"""What a run says at its end: how many frames came to what, and what to do where many were not tracked."""

from collections import Counter
from collections.abc import Sequence

from emgs_jax.localization import REASONS
from emgs_jax.running.record import FrameRecord

MANY = 0.1  # share of frames
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
)


def frame_lines(records: Sequence[FrameRecord], num_skipped: int) -> list[str]:
    """One line of counts; where many frames are degraded or lost, one more with the most frequent reason and a remedy.

    Args:
        records: of a run.
        num_skipped: frames that could not be read.
    """
    counts = Counter(record.status for record in records) | Counter(skipped=num_skipped)
    words = ("tracked", "degraded", "lost", "initialization", "skipped")
    lines = [f"{len(records) + num_skipped} frames: " + ", ".join(f"{counts[word]} {word}" for word in words)]
    bad = [record for record in records if record.status in ("degraded", "lost")]
    if len(bad) > MANY * len(records):
        reasons = Counter(reason for record in bad for reason in (record.reason or "").split("; ") if reason)
        reason, count = reasons.most_common(1)[0]
        lines.append(f"{len(bad)} frames were not tracked, {count} of them because {reason}: {REMEDIES[reason]}")
    return lines
