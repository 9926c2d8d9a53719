"""Coupling of a run and its back end: frames become nodes, and optimized poses return to records and map."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emgs_jax.back_end.loops import (
    consistent_loops,
    detect_loops,
    is_closure_due,
    not_in_graph,
    query_prior,
    recent_loops,
    remove_inconsistent,
    violated,
)
from emgs_jax.back_end.optimization import close_loops, merge_duplicates_of_state, nodes_of
from emgs_jax.back_end.state import add_node
from emgs_jax.device.arrays import to_se3
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.records import IN_MAP, NEW_SUBMAP, RELOCALIZED
from emgs_jax.mapping.run import MappingRun, row_of_first_node
from emgs_jax.mapping.window_input import WindowInput


def add_frames(run: MappingRun, window: WindowInput) -> MappingRun:
    """Add the recorded frames of an input to the pose graph; relocalized ones and new submaps are not connected."""
    end = run.back_end
    for frame, record in zip(window.data, run.records[-len(window.frames) :], strict=True):
        if record.location in (RELOCALIZED, NEW_SUBMAP):
            end = replace(end, connected_since=len(end.nodes))
        frame = replace(frame, depth_noise=record.depth_noise if record.status == "tracked" else None)
        is_placed = record.status in IN_MAP
        end = add_node(end, frame, record.pose, record.scale or 1.0, record.origin, is_placed)
    return replace(run, back_end=end)


def verify_loops(run: MappingRun, window: WindowInput) -> tuple[MappingRun, Sequence[LoopMeasurement] | None]:
    """Detect loops of the last frame, and verify those that the poses violate by the prior.

    Returns:
        The run, and the loops to close now; None where no closure is due.
    """
    before = run.back_end
    end = detect_loops(before, window.data[-1])
    loops = recent_loops(end)
    if is_closure_due(end, loops):
        end = query_prior(end, violated(end, loops), run.prior_query)
        loops = recent_loops(end)
    kept = remove_inconsistent(end) if len(end.violating) > len(before.violating) else end
    is_due = len(kept.accepted) < len(end.accepted) or is_closure_due(kept, loops)
    return replace(run, back_end=kept), loops if is_due else None


def optimize_and_deform(run: MappingRun, loops: Sequence[LoopMeasurement]) -> MappingRun:
    """Close loops: optimize the poses, and deform map and records accordingly."""
    end, state = close_loops(run.back_end, run.state, loops)
    return _with_updated_records(replace(run, back_end=end, state=state))


def finish_back_end(run: MappingRun) -> MappingRun:
    """Optimize the poses of a run once more, with all factors, and deform the map accordingly.

    Nothing changes where no loop violates, or has violated, the poses: frames and map fit each other better as first
    estimated. Else duplicate surfaces are merged that came to lie on each other and that nobody saw again.
    """
    end = run.back_end
    end = query_prior(end, violated(end, not_in_graph(end, consistent_loops(end))), run.prior_query)
    kept = remove_inconsistent(end)
    loops = violated(kept, not_in_graph(kept, consistent_loops(kept)))
    run = replace(run, back_end=kept)
    if len(kept.accepted) < len(end.accepted) or kept.accepted or loops:
        run = optimize_and_deform(run, loops)
    end, tracked = run.back_end, [record for record in run.records if record.status == "tracked"]
    noise = [record.depth_noise for record in tracked if record.depth_noise is not None]
    if noise and (end.accepted or not end.has_one_unit):  # at the end only: what was made one Gaussian stays one
        nodes = nodes_of(end, end.submap_id)
        state = merge_duplicates_of_state(run.state, nodes, float(np.median(noise)), run.config.existence)
        run = replace(run, state=state)
    return run


def _with_updated_records(run: MappingRun) -> MappingRun:
    """Write the back end's poses and scales into the records of its frames, which are the last ones.

    The prior's world moves with the last frame, where relocalization has anchored it.
    """
    end, first, motion = run.back_end, row_of_first_node(run), run.prior_motion
    if motion is not None:
        motion = to_se3(end.nodes[-1].pose @ np.linalg.inv(run.records[-1].pose)) @ motion
    found = zip(end.poses[end.first_node :], np.exp(end.log_scales[end.first_node :]).tolist(), strict=True)
    moved = [
        replace(record, pose=pose, scale=None if record.scale is None else scale)
        for record, (pose, scale) in zip(run.records[first:], found, strict=True)
    ]
    return replace(run, records=(*run.records[:first], *moved), prior_motion=motion)
