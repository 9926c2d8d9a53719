"""Second measurement of loops that are to move the poses: the prior predicts views of both visits together."""

from collections.abc import Sequence

from emgs_jax.data.base import Dataset
from emgs_jax.loops.alignment import Gate
from emgs_jax.loops.revisit import Ask, Revisit, combined, measured_again
from emgs_jax.loops.verification import LoopMeasurement
from emgs_jax.prior.base import Prior, visits
from emgs_jax.running.back_end import BackEnd, Refusal
from emgs_jax.running.clock import Clock

# What becomes of a question: a second measurement, no answer, or one without a pose or enough depths.
MEASURED, SILENT, UNUSABLE = "measured", "silent", "unusable"


def asking(prior: Prior, dataset: Dataset, spacing: int, window_size: int, clock: Clock) -> Ask:
    """Return a function by which a run's prior predicts both visits of a loop; the frames are read again."""

    def ask(a: int, b: int) -> Revisit | None:
        window = visits(a, b, spacing, window_size)
        with clock.phase("load"):
            frames = [dataset[index] for index in window.views]
        with clock.phase("predict"):
            found = prior.revisit(window, frames, dataset.intrinsics)
        if found is None:
            return None
        return Revisit(found.T_anchor_view[window.views.index(b)], tuple(found.points), tuple(found.mask))

    return ask


def ask_again(end: BackEnd, loops: Sequence[LoopMeasurement], ask: Ask) -> None:
    """Measure some loops once more, each once: what fits becomes more certain, what does not is no loop any more.

    What does not fit speaks against all loops that imply the same correction, as a contradiction that is seen does. A
    loop that the prior cannot be asked for stays as it is; so does one of a frame of another run.
    """
    keyframes = {keyframe.frame: keyframe for keyframe in end.database.keyframes}
    for loop in _chosen(end, loops):
        pair = loop.a, loop.b
        told = ask(*(end.frames[node] for node in pair))
        other = None if told is None else measured_again(told, *(keyframes[node] for node in pair), end.config.revisit)
        end.asked[pair] = MEASURED if other is not None else SILENT if told is None else UNUSABLE
        if other is None:
            continue
        both, misfit = combined(loop, other)
        row = [(known.a, known.b) for known in end.verified].index(pair)
        if misfit <= end.config.revisit.max_misfit:
            end.verified[row] = both
        else:
            end.contradicted.append(end.verified.pop(row))
            end.refusals.append(Refusal(*pair, Gate.REVISIT.value, misfit))


def _chosen(end: BackEnd, loops: Sequence[LoopMeasurement]) -> list[LoopMeasurement]:
    """Of each query the loop with most inliers that was not asked for yet; of these the best."""
    new = [loop for loop in loops if (loop.a, loop.b) not in end.asked and loop.a >= end.first]
    best = {loop.b: loop for loop in sorted(new, key=lambda loop: loop.num_inliers)}
    return sorted(best.values(), key=lambda loop: -loop.num_inliers)[: end.config.revisit.num_asked]
