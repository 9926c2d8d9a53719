"""Coupling of a run and its back end: frames become nodes, and optimized poses return to records and map."""

from dataclasses import replace

import numpy as np

from emgs_jax.running.back_end import (
    BackEnd,
    add_node,
    close_loops,
    consistent_loops,
    detect_loops,
    is_closure_due,
    nodes_of,
    not_in_graph,
    recent_loops,
    remove_inconsistent,
    violated,
)
from emgs_jax.running.convert import to_se3
from emgs_jax.running.deformation import merge_duplicates_of_state
from emgs_jax.running.disconnected_submaps import join_submaps
from emgs_jax.running.factors import FrameData
from emgs_jax.running.prior_queries import query_prior
from emgs_jax.running.record import IN_MAP, NEW_SUBMAP, RELOCALIZED, FrameRecord, MappingRun, row_of_first_node
from emgs_jax.running.relocalization import frame_data
from emgs_jax.running.window_input import WindowInput


def update_back_end(run: MappingRun, window_input: WindowInput) -> None:
    """Add the last input's frames to the back end, detect loops, and close them where the poses violate them.

    Args:
        run: with a back end, and a state.
        window_input: the last one.
    """
    added, frames = run.records[-len(window_input.frames) :], frame_data(window_input)
    for frame, record in zip(frames, added, strict=True):
        run.back_end = _with_frame(run.back_end, frame, record)
    if added[-1].similarity is not None:
        join_submaps(run, window_input)
    before = run.back_end
    end = detect_loops(before, frames[-1])
    loops = recent_loops(end)
    if is_closure_due(end, loops):
        end = query_prior(end, violated(end, loops), run.prior_query)
        loops = recent_loops(end)
    kept = remove_inconsistent(end) if len(end.violating) > len(before.violating) else end
    run.back_end = kept
    if len(kept.accepted) < len(end.accepted) or is_closure_due(kept, loops):
        run.back_end, run.state = close_loops(kept, run.state, loops)
        _update_records(run)


def _with_frame(end: BackEnd, frame: FrameData, record: FrameRecord) -> BackEnd:
    """Add a frame with its record as a node; after relocalization and in a new submap it is not connected."""
    if record.location in (RELOCALIZED, NEW_SUBMAP):
        end = replace(end, connected_since=len(end.poses))
    frame = replace(frame, depth_noise=record.depth_noise if record.status == "tracked" else None)
    return add_node(end, frame, record.pose, record.scale or 1.0, record.origin, record.status in IN_MAP)


def finish_back_end(run: MappingRun) -> None:
    """Optimize the poses of a run once more, with all factors, and deform the map accordingly.

    Nothing changes where no loop violates, or has violated, the poses: frames and map fit each other better as first
    estimated. Else duplicate surfaces are merged that came to lie on each other and that nobody saw again.
    """
    end = run.back_end
    end = query_prior(end, violated(end, not_in_graph(end, consistent_loops(end))), run.prior_query)
    kept = remove_inconsistent(end)
    loops = violated(kept, not_in_graph(kept, consistent_loops(kept)))
    run.back_end = kept
    if len(kept.accepted) < len(end.accepted) or kept.accepted or loops:
        run.back_end, run.state = close_loops(kept, run.state, loops)
        _update_records(run)
    end, tracked = run.back_end, [record for record in run.records if record.status == "tracked"]
    noise = [record.depth_noise for record in tracked if record.depth_noise is not None]
    if noise and (end.accepted or not end.has_one_unit):  # at the end only: what was made one Gaussian stays one
        nodes = nodes_of(end, end.submap_id)
        run.state = merge_duplicates_of_state(run.state, nodes, float(np.median(noise)), run.config.existence)


def _update_records(run: MappingRun) -> None:
    """Write the back end's poses and scales into the records of its frames, which are the last ones.

    The prior's world moves with the last frame, where relocalization has anchored it.
    """
    end, first = run.back_end, row_of_first_node(run)
    if run.prior_motion is not None:
        change = to_se3(end.poses[-1] @ np.linalg.inv(run.records[-1].pose))
        run.prior_motion = change @ run.prior_motion
    found = zip(end.poses[end.first_node :], np.exp(end.log_scales[end.first_node :]).tolist(), strict=True)
    run.records[first:] = [
        replace(record, pose=pose, scale=None if record.scale is None else scale)
        for record, (pose, scale) in zip(run.records[first:], found, strict=True)
    ]
