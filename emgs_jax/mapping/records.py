"""Records of frames, and alarms about those in a row that do not fit the map: nothing is fused while that lasts.

A pose is a (4, 4) float64 matrix, camera -> world, everywhere on the host; files write it as TUM's seven numbers.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from emgs_jax.geometry import Sim3, scale_covariance
from emgs_jax.io.trajectory import to_tum
from emgs_jax.localization import REASONS

IN_MAP = ("tracked", "initialization")  # statuses of frames that the map holds
APART = "apart"  # status of a frame that a submap holds which was never joined with the map
UNPLACED = ("lost", APART)  # statuses of frames whose pose says nothing in the map
# Outcomes of relocalization, `FrameRecord.location`; files have these words.
RELOCALIZED, RESTARTED, NEW_SUBMAP, JOINED = "found", "anew", "segment", "joined"
HIDDEN = "moving things fill the view"
NOT_FOUND = "its place in the saved map is not found"
UNJOINED = "its submap was never joined with the map (unjoined)"
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
            "the images show too little, such as one wall; take frames with more of the scene in view, or say how sure "
            "the prior's poses are (prior.pose_std=[metres, degrees], of prior=files and prior=recorded)",
        ),
        strict=True,
    )
) | {
    HIDDEN: "nothing is mapped until they are gone, or are no longer seen to move",
    NOT_FOUND: "take images of the same place, or map it anew without map=",
    UNJOINED: "take images that lead from there to the rest, closer together (dataset.stride=…)",
}


@dataclass(frozen=True)
class FrameRecord:
    """Outcome of one frame: a line of frames.jsonl. None where a frame was not a step.

    Args:
        status: tracked, degraded (the coarse pose stays, nothing is fused), lost (not even that is known),
            initialization (the map was made from it), apart (a submap holds it that was never joined with the map) or
            skipped (it cannot be read).
        location: outcome of relocalization: `found`, and the run continues from there; `anew`, and the map restarts
            from its coarse pose; or the reason of the failure. `segment`: a disconnected submap starts; `joined`: this
            frame connects it.
        pose: T_world_camera; of a lost frame what stands in for it.
        raw_pose: the same by the raw prediction; that of the frame before where it has none.
        true_pose: None where unknown.
        newest_pose: temporary pose of the next frame.
        covariance: (6, 6) of ξ where the true pose is T Exp(ξ), translation (m), rotation (rad); of the pose as first
            estimated, relative to the first frame (to a saved map in one).
        inliers: points that agree with the map.
        residual: of these to the map's planes, as a fraction of their depth.
        scale: factor on the prediction's lengths; the frames that a map is made from give it its unit.
        depth_noise: how much the points differ from the map, as a fraction of their depth; None where none agrees.
        step_m: between the coarse and the fine pose.
        similarity: where it is `joined`, the motion of its submap into the other: (4, 4) with e^σ R in the place of R.
        submap: number of the submap that holds it where it is apart; its pose is in that one's world.
        origin: frame whose Gaussians it was registered to (median of their births), counted from the map's first one.
        repeat_rms: robust standard deviation between the two predictions of the previous image, m.
        left_out: pixels with a prediction that is not finite, behind the camera or farther than a map can hold.
        moving: share of the pixels that are taken for moving.
        moving_pixels: which of the thinned image, see `to_run_lengths`; None where none is.
        fused: points that moved Gaussians.
        updated: Gaussians that they moved.
        mean_log_joint: of the fused points with their best Gaussians.
        candidates: Gaussians made from the points that were not fused.
        refined: of these, merged on the image plane.
        new: of these, added to the map.
        num_gaussians: in the map after this frame.
        overflow: splats beyond the capacity that would be seen.
        seconds: of mapping (conversion and step), compilation included.
        compile_seconds: of these.
    """

    index: int
    name: str | None
    timestamp: float | None
    status: str
    reason: str | None = None
    location: str | None = None
    pose: np.ndarray | None = None
    raw_pose: np.ndarray | None = None
    true_pose: np.ndarray | None = None
    newest_pose: np.ndarray | None = None
    covariance: np.ndarray | None = None
    inliers: int | None = None
    residual: float | None = None
    scale: float | None = None
    depth_noise: float | None = None
    step_m: float | None = None
    step_rad: float | None = None
    similarity: np.ndarray | None = None
    submap: int | None = None
    origin: int | None = None
    repeat_rms: float | None = None
    left_out: int = 0
    moving: float | None = None
    moving_pixels: Mapping[str, Any] | None = None
    fused: int | None = None
    updated: int | None = None
    mean_log_joint: float | None = None
    candidates: int | None = None
    refined: int | None = None
    new: int | None = None
    num_gaussians: int | None = None
    overflow: int | None = None
    seconds: float = 0.0
    compile_seconds: float = 0.0


def records_apart(records: Sequence[FrameRecord], number: int) -> list[FrameRecord]:
    """Those that the submap of this number holds, which was never joined with the map."""
    return [record for record in records if record.submap == number and record.status == APART]


def transform_record(record: FrameRecord, similarity: Sim3) -> FrameRecord:
    """Map poses, covariance and scale of a record to another world."""
    poses = {name: getattr(record, name) for name in ("pose", "newest_pose")}
    return replace(
        record,
        **{name: None if pose is None else similarity.apply_to_poses(pose) for name, pose in poses.items()},
        covariance=None if record.covariance is None else scale_covariance(record.covariance, similarity.scale),
        scale=None if record.scale is None else similarity.scale * record.scale,
    )


def to_line(record: FrameRecord) -> dict[str, Any]:
    """Convert a record to a line of frames.jsonl: poses as tx, ty, tz (m), qx, qy, qz, qw, the covariance by rows."""
    line = dict(vars(record))
    poses = {name: value for name, value in line.items() if name.endswith("pose") and value is not None}
    return line | {name: to_tum(pose) for name, pose in poses.items()}


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


def show_records(bar: tqdm, records: Sequence[FrameRecord], num_new: int) -> None:
    """Advance the progress bar by the new records and print an alarm where many frames in a row are untracked."""
    for count in range(len(records) - num_new + 1, len(records) + 1):
        message = None if bar.disable else alarm(records[:count])
        if message is not None:
            tqdm.write(message)
        last = records[count - 1]
        bar.set_postfix_str(f"{last.status}, {last.num_gaussians or 0} Gaussians", refresh=False)
        bar.update()
