"""Messages at the end of a run: frames by status, and remedies if many were not tracked."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from emgs_jax.device.clock import Clock
from emgs_jax.mapping.records import (
    APART,
    MANY_IN_A_ROW,
    REMEDIES,
    UNJOINED,
    UNTRACKED,
    FrameRecord,
    called,
    longest_row,
    main_reason,
)
from emgs_jax.ops.ranges import MAX_LENGTH_M
from emgs_jax.report.columns import (
    BY_PATH,
    MAIN,
    PLACED,
    RENDERED,
    SHARE,
    Table,
    aligned,
    if_lacking,
    lines_of,
    metric_table,
)
from emgs_jax.runs.moving import MUCH
from emgs_jax.runs.provenance import PLACED_PERCENT

MANY = 0.1  # share of frames
POLISHED = (  # key of polish.json, words, digits
    ("psnr_db", "PSNR, dB", 2),
    ("ssim", "SSIM", 3),
    ("depth_within_5_percent", "depth within 5 %, %", 1),
    ("depth_l1_m", "depth L1, m", 3),
    ("ate_m", "ATE of all frames, m", 4),
)


def frame_lines(records: Sequence[FrameRecord], num_skipped: int) -> list[str]:
    """Return one line of counts; if many frames are degraded or lost, one more with the main reason and a remedy.

    Many means a tenth of all, or `MANY_IN_A_ROW`, which are named, too.
    """
    counts = Counter(record.status for record in records) | Counter(skipped=num_skipped)
    words = ("tracked", "degraded", "lost", "initialization", "skipped", *[APART] * bool(counts[APART]))
    lines = [f"{len(records) + num_skipped} frames: " + ", ".join(f"{counts[word]} {word}" for word in words)]
    if counts[APART]:
        lines.append(f"{counts[APART]} frames are in submaps/, never joined with the map: {REMEDIES[UNJOINED]}")
    bad, row = [record for record in records if record.status in UNTRACKED], longest_row(records)
    if len(bad) > MANY * len(records) or len(row) >= MANY_IN_A_ROW:
        reason, count = main_reason(bad)
        end = "to the end" if row.stop == len(records) else f"to {called(records[row[-1]])}"
        where = f" ({len(row)} in a row, from {called(records[row[0]])} {end})" if len(row) > 1 else ""
        lines.append(f"{len(bad)} frames were not tracked{where}, {count} of them because {reason}: {REMEDIES[reason]}")
    if left_out := [record for record in records if record.left_out]:
        count = sum(record.left_out for record in left_out)
        lines.append(
            f"{count} points of {len(left_out)} frames, from {called(left_out[0])} on, were left out: the prior's "
            f"depth there is not finite, not positive, or farther than a map can hold ({MAX_LENGTH_M:g} m)"
        )
    if moving := [record for record in records if (record.moving or 0.0) >= MUCH]:
        most = max(moving, key=lambda record: record.moving)
        lines.append(
            f"in {len(moving)} frames something moves, most of it in {called(most)} ({100 * most.moving:.0f} % of the "
            "pixels): it is not mapped; `moving` in frames.jsonl, slam/motion=paper takes all for static"
        )
    return lines


def time_words(clock: Clock, num_frames: int) -> str:
    """Describe the time of a run: per frame, by phase, and for compilation."""
    whole, phases = sum(clock.phases.values()), ", ".join(f"{name} {s:.1f}" for name, s in clock.phases.items())
    pace = f"{whole:.1f} s, {whole / max(num_frames, 1):.2f} s a frame"
    return f"{pace}: {phases}; of all that compilation {clock.compile_seconds:.1f}"


def last_words(metrics: Mapping[str, Any]) -> str:
    """Say for a run's last line how many frames are not in the map, and from which one on; empty if all are."""
    count = metrics["frames/degraded"] + metrics["frames/lost"]
    if not count:
        return ""
    others = ("tracked", "initialization", "skipped", APART)
    whole = count + sum(metrics.get(f"frames/{status}", 0) for status in others)
    row, start = metrics["frames/longest_untracked"], metrics["frames/longest_untracked_from"]
    apart = metrics["submaps/unjoined_frames"]
    words = f", {apart} are in submaps that were never joined with the map" if apart else ""
    return f"{count} of {whole} frames are degraded or lost, {row} in a row from frame {start} on{words}; "


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Lay out the main metrics, one row for the map, the raw prior and each baseline; `–` for a missing value.

    Clouds aligned by ICP come first, as in the README; below are the same rows aligned by trajectory, and renderings at
    their own poses.
    """
    block, tables = metrics.get("provenance", {}), []
    names = [str((block.get("data") or {}).get("name"))]
    for columns in ((MAIN[0], SHARE, *PLACED), (*BY_PATH, *RENDERED)):
        if lines := lines_of(metrics, columns):
            shown = if_lacking(columns, [metrics])
            tables.append(aligned(metric_table([_label(block)], shown, lines, names)))
    return "\n\n".join(tables)


def why_no_errors(metrics: Mapping[str, Any]) -> str:
    """Say why a run has no errors."""
    why = "no placed frame has a true pose" if PLACED_PERCENT in metrics else "no ground truth"
    return f"{why}, so no errors"


def _label(block: Mapping[str, Any]) -> str:
    """Label a table: empty for measured numbers, otherwise `simulated` with its version."""
    if not block.get("simulated", False):
        return ""
    name = (block.get("prior") or {}).get("name", "")
    return name if name.startswith("simulated v") else "simulated"


def polish_lines(found: Mapping[str, Any]) -> list[str]:
    """Describe the held-out frames by polish.json, in lines."""
    held = found["polish/num_held_out"]
    covered = found.get("polish/num_covered", held)  # earlier versions counted all
    of = held if covered == held else f"the {covered} that the map covers of {held}"
    lines = [f"{found['polish/num_splats']:,} splats; of {of} frames that were not fitted:"]
    lines.append(aligned(polish_table(found)))
    if covered and found["polish/after_psnr_db"] < found["polish/before_psnr_db"]:
        lines.append("the splats show less than the map: the frames are too few, or too far apart (dataset.stride=…)")
    return lines


def polish_table(found: Mapping[str, Any]) -> Table:
    """Lay out map and splats side by side on the held-out frames, by polish.json."""
    rows = [
        (words, *(f"{float(found[f'polish/{when}_{name}']):.{digits}f}" for when in ("before", "after")))
        for name, words, digits in POLISHED
        if found.get(f"polish/before_{name}") is not None
    ]
    return Table(("held-out frames", "map", "splats"), rows)
