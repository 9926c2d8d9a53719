"""A run that follows its back end: what its frames measure goes there, and better poses come back."""

from dataclasses import replace

import numpy as np

from emgs_jax.running.convert import to_se3
from emgs_jax.running.following import settle
from emgs_jax.running.inputs import Input
from emgs_jax.running.locating import looks_of
from emgs_jax.running.record import FOUND, PLACED, SEGMENT, MappingRun, row_of_first_node
from emgs_jax.running.revisiting import ask_again
from emgs_jax.running.segments import join


def correct(run: MappingRun, given: Input) -> None:
    """Tell the back end of the frames that `given` added, and let poses and map follow what it finds.

    Args:
        run: with a back end, and a state.
        given: what was taken.
    """
    end, added, looks = run.back_end, run.records[-len(given.frames) :], looks_of(given)
    for look, record in zip(looks, added, strict=True):
        if record.location in (FOUND, SEGMENT):
            end.since = len(end.poses)
        look = replace(look, depth_noise=record.depth_noise if record.status == "tracked" else None)
        end.add(look, record.pose, record.scale or 1.0, record.origin, record.status in PLACED)
    if added[-1].similarity is not None:
        join(run, given)
    num_contradicted = len(end.contradicted)
    found = end.look_for_loops(looks[-1])
    if end.wants_to_close(found):
        ask_again(end, end.news(found), run.ask)
        found = end.recent()
    has_retracted = len(end.contradicted) > num_contradicted and end.retract(end.agreed()) > 0
    if has_retracted or end.wants_to_close(found):
        run.state = end.close(run.state, found)
        _take_poses(run)


def finish(run: MappingRun) -> None:
    """Optimize the poses of a run once more, with all factors, and deform the map accordingly.

    Nothing changes where no loop violates, or has violated, the poses: frames and map fit each other better as first
    estimated. Else duplicate surfaces are merged that came to lie on each other and that nobody saw again.
    """
    end = run.back_end
    ask_again(end, end.news(end.new(end.agreed())), run.ask)
    agreed = end.agreed()
    has_retracted = end.retract(agreed) > 0
    loops = end.news(end.new(agreed))
    if has_retracted or end.accepted or loops:
        run.state = end.close(run.state, loops)
        _take_poses(run)
    tracked = [record for record in run.records if record.status == "tracked"]
    noise = [record.depth_noise for record in tracked if record.depth_noise is not None]
    if noise and (end.accepted or not end.has_one_unit):  # at the end only: what was made one Gaussian stays one
        run.state = settle(run.state, end.nodes(end.segment), float(np.median(noise)), run.config.existence)


def _take_poses(run: MappingRun) -> None:
    """The back end's poses and scales into the records of its frames, which are the last ones.

    The prior's world goes with the last frame, where it is known by a frame that was found.
    """
    end, first = run.back_end, row_of_first_node(run)
    if run.prior_motion is not None:
        change = to_se3(end.poses[-1] @ np.linalg.inv(run.records[-1].pose))
        run.prior_motion = change @ run.prior_motion
    found = zip(end.poses[end.first :], np.exp(end.log_scales[end.first :]).tolist(), strict=True)
    run.records[first:] = [
        replace(record, pose=pose, scale=None if record.scale is None else scale)
        for record, (pose, scale) in zip(run.records[first:], found, strict=True)
    ]
