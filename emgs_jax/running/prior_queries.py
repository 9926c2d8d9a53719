"""Queries of the prior for a second measurement of a loop: it predicts views of both visits together."""

from collections.abc import Sequence
from dataclasses import replace

from emgs_jax.data.base import Dataset
from emgs_jax.loop_closure.prior_query import JointPrediction, PriorQuery, fuse_measurements, measure_by_prior
from emgs_jax.loop_closure.two_view_alignment import Gate
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.prior.base import Prior, visits
from emgs_jax.running.back_end import BackEnd, Refusal
from emgs_jax.running.clock import Clock

# Outcomes of a query: a second measurement, no answer, or an answer without a pose or enough depths.
MEASURED, SILENT, UNUSABLE = "measured", "silent", "unusable"


def make_prior_query(prior: Prior, dataset: Dataset, spacing: int, window_size: int, clock: Clock) -> PriorQuery:
    """Return a function by which a run's prior predicts both visits of a loop; the frames are read again."""

    def query(a: int, b: int) -> JointPrediction | None:
        window = visits(a, b, spacing, window_size)
        with clock.phase("load"):
            frames = [dataset[index] for index in window.views]
        with clock.phase("predict"):
            found = prior.revisit(window, frames, dataset.intrinsics)
        if found is None:
            return None
        return JointPrediction(found.T_anchor_view[window.views.index(b)], tuple(found.points), tuple(found.mask))

    return query


def query_prior(end: BackEnd, loops: Sequence[LoopMeasurement], query: PriorQuery) -> BackEnd:
    """Query the prior for loops, each once: a measurement that fits is fused, any other rejects the loop.

    A rejected loop is evidence against all loops that imply the same correction, as a free-space violation is. A loop
    without an answer stays as it is; so does one with a frame of another run.
    """
    keyframes = {keyframe.frame: keyframe for keyframe in end.database.keyframes}
    for loop in _loops_to_query(end, loops):
        pair = loop.a, loop.b
        answer = query(*(end.frames[node] for node in pair))
        other = (
            None
            if answer is None
            else measure_by_prior(answer, *(keyframes[node] for node in pair), end.config.prior_query)
        )
        outcome = MEASURED if other is not None else SILENT if answer is None else UNUSABLE
        end = replace(end, queries=end.queries | {pair: outcome})
        if other is None:
            continue
        both, misfit = fuse_measurements(loop, other)
        known = end.verified
        row = [(one.a, one.b) for one in known].index(pair)
        before, after = end.verified[:row], end.verified[row + 1 :]
        if misfit <= end.config.prior_query.max_misfit:
            end = replace(end, verified=[*before, both, *after])
        else:
            refusal = Refusal(*pair, Gate.PRIOR_QUERY.value, misfit)
            end = replace(end, verified=[*before, *after], refusals=[*end.refusals, refusal])
            end = replace(end, violating=[*end.violating, known[row]])
    return end


def _loops_to_query(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Select new loops with most inliers: the best of each query frame, and of these `max_queries`."""
    new = [loop for loop in loops if (loop.a, loop.b) not in end.queries and loop.a >= end.first_node]
    best = {loop.b: loop for loop in sorted(new, key=lambda loop: loop.num_inliers)}
    return sorted(best.values(), key=lambda loop: -loop.num_inliers)[: end.config.prior_query.max_queries]
