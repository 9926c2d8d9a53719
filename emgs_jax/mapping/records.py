"""The log of a run: a record for each frame, which the mapping never reads, and alarms about frames that do not fit.

A pose is a (4, 4) float64 matrix, camera -> world, everywhere on the host; files write it as TUM's seven numbers.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from emgs_jax.back_end.state import Node
from emgs_jax.device.arrays import to_matrix
from emgs_jax.existence import Seen
from emgs_jax.io.run_lengths import from_run_lengths, to_run_lengths
from emgs_jax.io.trajectory import to_tum
from emgs_jax.localization import REASONS
from emgs_jax.mapping.event import JOINED, NEW_SUBMAP, RESTARTED, Event
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.slam import StepInfo

IN_MAP = ("tracked", "initialization")  # statuses of frames that the map holds
APART = "apart"  # status of a frame in a submap that was never joined with the map
UNPLACED = ("lost", APART)  # statuses of frames without a meaningful pose in the map
HIDDEN = "moving things fill the view"
NOT_FOUND = "its place in the saved map is not found"
UNJOINED = "its submap was never joined with the map (unjoined)"
MANY_IN_A_ROW = 10  # single frames fail in every long sequence, but not this many in a row
UNTRACKED = ("degraded", "lost")
MOST_MOVING = 0.5  # of the pixels; if more move, they are what hides the map
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
    """Outcome of one frame: a line of frames.jsonl. Fields of a step are None for a frame that was no step.

    Args:
        status: tracked, degraded (the coarse pose stays, nothing is fused), lost (the prior says no pose, and
            this one is a guess),
            initialization (the map was made from it), apart (in a submap that was never joined with the map) or skipped
            (it cannot be read).
        location: outcome of relocalization: `relocalized`, and the run continues from there; `restarted`, and the map
            restarts from the coarse pose; or the reason of the failure. `new_submap`: a disconnected submap starts;
            `joined`: this frame joins it.
        pose: T_world_camera; a placeholder for a lost frame.
        raw_pose: the same by the raw prediction; that of the previous frame if there is none.
        true_pose: None if unknown.
        newest_pose: temporary pose of the next frame, as first estimated.
        covariance: (6, 6) of ξ, if the true pose is T Exp(ξ): translation (m), rotation (rad); of the pose as first
            estimated, relative to the first frame (or to a saved map).
        inliers: points that agree with the map.
        residual: of the inliers to the map's planes, as a fraction of their depth.
        scale: factor on the prediction's lengths; the frames that a map is made from define its unit.
        depth_noise: difference of the points from the map, as a fraction of their depth; None if none agrees.
        step_m: between the coarse and the fine pose.
        similarity: of a `joined` frame, the motion of its submap into the other: (4, 4) with e^σ R in place of R.
        submap: number of the submap of an `apart` frame; its pose is in that submap's world.
        origin: frame whose Gaussians it was registered to (median of their births), counted from the map's first one.
        repeat_rms: robust standard deviation between the two predictions of the previous image, m.
        left_out: pixels with a prediction that is not finite, behind the camera or farther than a map can hold.
        moving: share of moving pixels, including those found by later frames.
        moving_pixels: which pixels of the thinned image move, see `to_run_lengths`; None if none do.
        fused: points that were fused into Gaussians.
        updated: Gaussians that they updated.
        mean_log_joint: of the fused points with their best Gaussians.
        candidates: Gaussians made from the points that were not fused.
        refined: of these, merged on the image plane.
        new: of these, added to the map.
        num_gaussians: in the map after this frame.
        overflow: splats that did not fit and would be visible.
        seconds: of mapping (conversion and step), including compilation.
        compile_seconds: of compilation.
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
    """Select the records in the submap of this number, which was never joined with the map."""
    return [record for record in records if record.submap == number and record.status == APART]


def records_of(window: WindowInput, event: Event) -> list[FrameRecord]:
    """Make the records of an input's frames, which share its seconds."""
    share = {name: value / len(event.poses) for name, value in event.seconds.items()}
    described = _described(event)
    return [
        FrameRecord(
            index=frame.index,
            name=frame.name,
            timestamp=frame.timestamp,
            raw_pose=raw.T_world_camera,
            true_pose=frame.T_world_camera,
            left_out=raw.num_left_out,
            pose=pose,
            location=event.location,
            **described | share,
        )
        for frame, raw, pose in zip(window.frames, window.raw, event.poses, strict=True)
    ]


def _described(event: Event) -> dict[str, Any]:
    """Return the fields of a record that an event fills."""
    if event.info is None and not event.is_start:
        return {"status": "lost", "reason": REASONS[0] if event.location is None else NOT_FOUND}
    if event.info is None:
        new = event.num_gaussians if event.location == NEW_SUBMAP else None
        return {"status": "initialization", "scale": 1.0, "new": new, "num_gaussians": event.num_gaussians}
    fields = _step_fields(event.info) | {"similarity": event.similarity, "covariance": event.covariance}
    fields |= {"depth_noise": event.depth_noise, "origin": event.origin, "num_gaussians": event.num_gaussians}
    if event.is_start:
        return fields | {"status": "initialization", "new": event.num_gaussians - int(event.info.num_gaussians)}
    return fields | ({"fused": 0, "updated": 0, "new": 0} if event.is_frozen else {})


def _step_fields(info: StepInfo) -> dict[str, Any]:
    """Return the fields of a record that a step fills; `info` is on the host."""
    localization, em, refinement = info.localization, info.em, info.refinement
    reasons = [words for bit, words in enumerate(REASONS) if int(localization.reason) >> bit & 1]
    moving = float(np.mean(info.moving))
    pixels = to_run_lengths(info.moving) if moving else None
    reasons = [HIDDEN] if reasons and moving > MOST_MOVING else reasons
    return {
        "status": "tracked" if localization.is_tracked else "lost" if localization.is_lost else "degraded",
        "reason": "; ".join(reasons) or None,
        "newest_pose": to_matrix(info.T_world_newest.wxyz_xyz),
        "inliers": int(localization.icp.num_inliers),
        "residual": float(localization.icp.residual),
        "scale": float(localization.scale),
        "step_m": float(localization.step_m),
        "step_rad": float(localization.step_rad),
        "repeat_rms": float(localization.repeat_rms),
        "moving": moving,
        "moving_pixels": pixels,
        "fused": int(em.num_fused),
        "updated": int(em.num_updated),
        "mean_log_joint": float(em.mean_log_joint) if em.num_fused else None,
        "candidates": int(refinement.num_candidates),
        "refined": int(refinement.num_merged),
        "new": int(refinement.num_fresh),
        "overflow": int(info.overflow.tiles),
    }


def with_moved_nodes(
    records: Sequence[FrameRecord], before: Sequence[Node], after: Sequence[Node]
) -> Sequence[FrameRecord]:
    """Update the records of changed nodes by pose, scale and covariance; the last node has the last record.

    Args:
        before: nodes when the records were written, except those added with the last records.
    """
    found, first = list(records), len(records) - len(after)
    for row in range(max(0, -first), len(after)):
        node, record = after[row], found[first + row]
        is_same = node is before[row] if row < len(before) else np.array_equal(node.pose, record.pose)
        if not is_same:
            scale = None if record.scale is None else float(np.exp(node.log_scale))
            found[first + row] = replace(record, pose=node.pose, scale=scale, covariance=node.covariance)
    return tuple(found)


def with_unjoined_apart(records: Sequence[FrameRecord], nodes: Sequence[Node], kept: int) -> Sequence[FrameRecord]:
    """Mark the records of all nodes outside the kept submap as apart: theirs was never joined with it."""
    found, first = list(records), len(records) - len(nodes)
    for row in range(max(0, -first), len(nodes)):
        node, record = nodes[row], found[first + row]
        if node.submap != kept:
            status = APART if record.status in IN_MAP else "lost"
            known = {"status": status, "reason": UNJOINED, "submap": node.submap, "covariance": node.covariance}
            found[first + row] = replace(record, **known)
    return tuple(found)


def with_moved_pixels(records: Sequence[FrameRecord], seen: Seen, time: int, shape: tuple[int, int]) -> Sequence:
    """Update an earlier frame's record by what later frames have shown to move in it.

    Args:
        seen: that frame, on the host.
        time: of the frame of the last record, see `SlamState`.
        shape: (h, w) of the thinned image.
    """
    if not seen.moves.any():
        return records
    found, row, moves = list(records), len(records) - 1 - (time - int(seen.time)), seen.moves.reshape(shape)
    known = found[row].moving_pixels
    moves = moves if known is None else moves | from_run_lengths(known)
    found[row] = replace(found[row], moving=float(np.mean(moves)), moving_pixels=to_run_lengths(moves))
    return tuple(found)


def to_line(record: FrameRecord) -> dict[str, Any]:
    """Convert a record to a line of frames.jsonl: poses as tx, ty, tz (m), qx, qy, qz, qw, the covariance by rows."""
    line = dict(vars(record))
    poses = {name: value for name, value in line.items() if name.endswith("pose") and value is not None}
    return line | {name: to_tum(pose) for name, pose in poses.items()}


def alarm(records: Sequence[FrameRecord]) -> str | None:
    """Return the message after a run's last record, if any: many untracked frames, tracked again, or a new submap."""
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
    """Return the untracked frames at the end, at most `most`."""
    count = 0
    while count < min(most, len(records)) and records[-1 - count].status in UNTRACKED:
        count += 1
    return records[len(records) - count :]


def show_records(
    bar: tqdm, records: Sequence[FrameRecord], num_new: int, words_of: Callable[[int], str] = lambda index: ""
) -> None:
    """Advance the progress bar by the new records, and print an alarm if many frames in a row are untracked.

    `words_of` gives what is to be said of a frame beside its outcome.
    """
    for count in range(len(records) - num_new + 1, len(records) + 1):
        message = None if bar.disable else alarm(records[:count])
        if message is not None:
            tqdm.write(message)
        last = records[count - 1]
        words = [last.status, f"{last.num_gaussians or 0} Gaussians", words_of(last.index)]
        bar.set_postfix_str(", ".join(filter(None, words)), refresh=False)
        bar.update()
