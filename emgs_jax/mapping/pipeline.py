"""The pipeline over a sequence: inputs are integrated one by one into a run."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from emgs_jax.data.base import Dataset
from emgs_jax.device.clock import Timer
from emgs_jax.mapping.capacity import advance, prepare_step, start
from emgs_jax.mapping.checkpoint import Checkpoint, Keeper
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.finalize import rescale_run, with_first_frame
from emgs_jax.mapping.loop_closing import add_frames, finish_back_end, optimize_and_deform, verify_loops
from emgs_jax.mapping.records import NEW_SUBMAP, RELOCALIZED, FrameRecord
from emgs_jax.mapping.relocalization import (
    as_step_prediction,
    move_prediction,
    not_found_message,
    reanchor_prior,
    relocalize_lost,
    state_in_saved_map,
    step_prediction,
    with_saved_map,
)
from emgs_jax.mapping.run import MappingRun, TrackedFrame, record_lost, record_new_submap, record_start, record_step
from emgs_jax.mapping.submaps import (
    enter_submap,
    join_submaps,
    match_submap,
    return_to_world,
    set_unjoined_apart,
    start_submap,
)
from emgs_jax.mapping.window_input import RawView, WindowInput, make_prior_query, window_inputs
from emgs_jax.prior.base import Prior


def map_frames(
    run: MappingRun, dataset: Dataset, prior: Prior, keeper: Keeper | None = None
) -> Iterator[tuple[MappingRun, Sequence[FrameRecord], Sequence[RawView]]]:
    """Map a sequence, input by input; `finish_run` completes the last run.

    Args:
        keeper: of the run's checkpoint, from which it resumes where there is one.

    Yields:
        The run after an input; the records of its new frames as first estimated; and their raw predictions.

    Raises:
        ValueError: no frame has a point and a pose from which a map can start.
    """
    keeper = keeper or Keeper()
    if run.back_end is not None and run.back_end.config.prior_query.is_used:
        spacing = run.back_end.config.prior_query.spacing
        query = make_prior_query(prior, dataset, spacing, run.config.window_size, run.clock)
        run = replace(run, prior_query=query)
    num_known = 0 if keeper.found is None else keeper.found.num_inputs
    try:
        for number, window in enumerate(window_inputs(dataset, prior, run.config, run.clock), 1):
            with run.clock.phase("map"):
                if number > num_known:
                    run, records = integrate(run, window)
                else:
                    run, records = replay(run, window, keeper.found, is_last=number == num_known)
            keeper.keep(run, records)
            yield run, records, window.raw
        keeper.save()
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to show
            keeper.save()
        raise
    if run.saved is not None and run.state is None:
        raise ValueError(not_found_message(run))


def finish_run(run: MappingRun, is_interrupted: bool = False) -> MappingRun:
    """Complete a run after its last input; one that was interrupted gets the same unit, and is not optimized again."""
    run = set_unjoined_apart(run)
    if run.back_end is not None and not run.is_fixed and not is_interrupted:
        with run.clock.phase("back_end"):
            run = finish_back_end(run)
    return rescale_run(with_first_frame(run))


def integrate(run: MappingRun, window: WindowInput) -> tuple[MappingRun, Sequence[FrameRecord]]:
    """Integrate one input into a run; return it, and the new records as first estimated."""
    tracked = track(run, window)
    return update_back_end(tracked, window), tracked.records[len(run.records) :]


def track(run: MappingRun, window: WindowInput) -> MappingRun:
    """Start a map or a submap from an input, or step with it; and record what became of its frames."""
    timer = Timer(run.clock)
    if window.prediction is None:
        return record_lost(run, window)
    if isinstance(window.prediction, FirstWindow):
        run = start_map(run, window.prediction)
        if run.saved is None:
            return record_start(run, window, seconds_of(window, timer))
    run = return_to_world(run, window)
    submap = start_submap(run, window)
    if submap is not None:
        return record_new_submap(submap, window, seconds_of(window, timer))
    tracked, frame = step_frame(run, window)
    tracked, frame = relocalize_lost(run, tracked, frame, window)
    if frame.info is None:
        return record_lost(tracked, window, frame.location)
    if tracked.is_fixed:
        tracked = with_saved_map(tracked)
    frame = match_submap(tracked, window, frame)
    return reanchor_prior(record_step(tracked, window, frame, seconds_of(window, timer)), window)


def start_map(run: MappingRun, first: FirstWindow) -> MappingRun:
    """Prepare the step for the first window, and start the map of a run that continues in none."""
    prepare_step(first.views, run.camera, run.config)
    if run.saved is not None:
        return run
    state, config = start(first, run.camera, run.config)
    return replace(run, state=state, config=config)


def step_frame(run: MappingRun, window: WindowInput) -> tuple[MappingRun, TrackedFrame]:
    """Run one step; nothing happens where the camera has no pose yet."""
    frame = TrackedFrame(step_prediction(run, window))
    if run.state is None:
        return run, frame
    prediction = move_prediction(frame.prediction, run.prior_motion)
    state, info, config = advance(run.state, prediction, run.camera, run.config)
    return replace(run, state=state, config=config), replace(frame, info=info)


def update_back_end(run: MappingRun, window: WindowInput) -> MappingRun:
    """Add frames to the pose graph, join submaps; detect and verify loops, optimize the poses and deform the map."""
    if run.back_end is None or run.state is None or run.is_fixed:
        return run
    with run.clock.phase("back_end"):
        run = add_frames(run, window)
        if run.records[-1].similarity is not None:
            run = join_submaps(run, window)
        run, loops = verify_loops(run, window)
        return run if loops is None else optimize_and_deform(run, loops)


def replay(
    run: MappingRun, window: WindowInput, checkpoint: Checkpoint, is_last: bool
) -> tuple[MappingRun, Sequence[FrameRecord]]:
    """Replay an input from a checkpoint's records, as `integrate`; after the last one the states are the checkpoint's.

    Until then the back end deforms a map that the checkpoint's replaces.
    """
    if isinstance(window.prediction, FirstWindow):
        run = start_map(run, window.prediction)
    first = len(run.records)
    records = tuple(checkpoint.records[first : first + len(window.frames)])
    run = replace(return_to_world(run, window), records=(*run.records, *records))
    if records[-1].location == NEW_SUBMAP:
        run = enter_submap(run, window)
    run = reanchor_prior(run, window)
    if run.state is None and records[-1].location == RELOCALIZED:
        run = replace(run, state=state_in_saved_map(run, as_step_prediction(window.prediction)))
    run = update_back_end(run, window)
    return checkpoint.restored(run) if is_last else run, records


def seconds_of(window: WindowInput, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Add the seconds of the conversion to those of a timer, which `num_sharing` runs share equally."""
    return {name: window.seconds.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}
