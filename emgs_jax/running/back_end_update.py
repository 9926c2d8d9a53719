"""Coupling of a run and its back end: frames become nodes, and optimized poses return to records and map."""

from dataclasses import replace

import numpy as np

from emgs_jax.running.convert import to_se3
from emgs_jax.running.deformation import merge_duplicates_of_state
from emgs_jax.running.disconnected_submaps import join_submaps
from emgs_jax.running.prior_queries import query_prior
from emgs_jax.running.record import IN_MAP, NEW_SUBMAP, RELOCALIZED, MappingRun, row_of_first_node
from emgs_jax.running.relocalization import frame_data
from emgs_jax.running.window_input import WindowInput


def update_back_end(run: MappingRun, window_input: WindowInput) -> None:
    """Add the last input's frames to the back end, detect loops, and close them where the poses violate them.

    Args:
        run: with a back end, and a state.
        window_input: the last one.
    """
    end, added, frames = run.back_end, run.records[-len(window_input.frames) :], frame_data(window_input)
    for frame, record in zip(frames, added, strict=True):
        if record.location in (RELOCALIZED, NEW_SUBMAP):
            end.connected_since = len(end.poses)
        frame = replace(frame, depth_noise=record.depth_noise if record.status == "tracked" else None)
        end.add_node(frame, record.pose, record.scale or 1.0, record.origin, record.status in IN_MAP)
    if added[-1].similarity is not None:
        join_submaps(run, window_input)
    num_violating = len(end.violating)
    found = end.detect_loops(frames[-1])
    if end.is_closure_due(found):
        query_prior(end, end.violated(found), run.prior_query)
        found = end.recent_loops()
    has_retracted = len(end.violating) > num_violating and end.retract_inconsistent(end.consistent()) > 0
    if has_retracted or end.is_closure_due(found):
        run.state = end.close_loops(run.state, found)
        _update_records(run)


def finish_back_end(run: MappingRun) -> None:
    """Optimize the poses of a run once more, with all factors, and deform the map accordingly.

    Nothing changes where no loop violates, or has violated, the poses: frames and map fit each other better as first
    estimated. Else duplicate surfaces are merged that came to lie on each other and that nobody saw again.
    """
    end = run.back_end
    query_prior(end, end.violated(end.not_in_graph(end.consistent())), run.prior_query)
    consistent = end.consistent()
    has_retracted = end.retract_inconsistent(consistent) > 0
    loops = end.violated(end.not_in_graph(consistent))
    if has_retracted or end.accepted or loops:
        run.state = end.close_loops(run.state, loops)
        _update_records(run)
    tracked = [record for record in run.records if record.status == "tracked"]
    noise = [record.depth_noise for record in tracked if record.depth_noise is not None]
    if noise and (end.accepted or not end.has_one_unit):  # at the end only: what was made one Gaussian stays one
        run.state = merge_duplicates_of_state(
            run.state, end.nodes(end.submap_id), float(np.median(noise)), run.config.existence
        )


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
