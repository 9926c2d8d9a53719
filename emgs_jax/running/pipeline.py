"""The pipeline over a sequence: inputs are integrated one by one into a run."""

import contextlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence

import jax
import jaxlie
from omegaconf import OmegaConf
from tqdm import tqdm

from emgs_jax.data.base import Dataset
from emgs_jax.observation import Prediction
from emgs_jax.prior.base import Prior
from emgs_jax.running.back_end import relocalize_frame
from emgs_jax.running.back_end_update import finish_back_end, update_back_end
from emgs_jax.running.capacity import advance, prepare_step, restart_map, start
from emgs_jax.running.checkpoint import Checkpoint, Keeper
from emgs_jax.running.clock import Clock, Timer
from emgs_jax.running.compilation import use_compilation_cache
from emgs_jax.running.configure import RunConfig, build_dataset, build_prior
from emgs_jax.running.convert import FirstWindow
from emgs_jax.running.disconnected_submaps import (
    drop_unjoined_submaps,
    enter_submap,
    in_structure,
    is_related,
    match_submap,
    place_structure,
    start_submap,
    step_prediction,
)
from emgs_jax.running.first_frame import with_first_frame
from emgs_jax.running.prior_queries import make_prior_query
from emgs_jax.running.record import (
    JOINED,
    NEW_SUBMAP,
    RELOCALIZED,
    RESTARTED,
    FrameRecord,
    MappingRun,
    new_run,
    record_lost,
    record_new_submap,
    record_start,
    record_step,
)
from emgs_jax.running.relocalization import (
    anchor_motion_of,
    as_step_prediction,
    frame_data,
    is_relocalization_due,
    is_restart_due,
    move_prediction,
    not_found_message,
    rejection,
    relocalized_start,
    replace_map,
    state_in_saved_map,
)
from emgs_jax.running.saved_map import load_saved_map
from emgs_jax.running.unit import rescale_run
from emgs_jax.running.untracked import alarm
from emgs_jax.running.window_input import RawView, WindowInput, window_inputs
from emgs_jax.slam import StepInfo


def map_sequence(config: RunConfig, show_progress: bool = True) -> MappingRun:
    """Map the sequence of a config; the run holds the map, and a record with a pose for every frame.

    Args:
        config: of `load_config`.
        show_progress: draw a bar.

    Raises:
        ValueError: the data set, the prior or a frame cannot be used.
    """
    settings = OmegaConf.create(config.settings)
    use_compilation_cache(settings.compilation_cache)
    dataset = build_dataset(settings)
    prior = build_prior(settings, dataset)
    saved = load_saved_map(
        settings.map, settings.map_mode, config.graph, dataset.intrinsics, float(config.slam.fit.min_std)
    )
    with (
        Clock().watching() as clock,
        tqdm(total=len(dataset), unit="frame", desc="mapping", disable=not show_progress) as bar,
    ):
        run = new_run(dataset, config.slam, clock, graph=config.graph, saved=saved)
        run.on_record = lambda record: show_records(bar, run.records)
        deque(map_frames(run, dataset, prior), maxlen=0)
    return run


def show_records(bar: tqdm, records: Sequence[FrameRecord]) -> None:
    """Advance the progress bar by one frame and print an alarm where many frames in a row are untracked."""
    message = None if bar.disable else alarm(records)
    if message is not None:
        tqdm.write(message)
    bar.set_postfix_str(f"{records[-1].status}, {records[-1].num_gaussians or 0} Gaussians", refresh=False)
    bar.update()


def map_frames(run: MappingRun, dataset: Dataset, prior: Prior, keeper: Keeper | None = None) -> Iterator[RawView]:
    """Map a sequence into `run`; yields the raw predictions of each frame on the way, for comparison.

    Args:
        run: before its first frame.
        dataset: of the frames.
        prior: of the predictions.
        keeper: of the run's checkpoint, from which it resumes where there is one.

    Raises:
        ValueError: no frame has a point and a pose from which a map can start.
    """
    keeper = keeper or Keeper()
    keeper.attend(run)
    if run.back_end is not None and run.back_end.config.prior_query.is_used:
        spacing = run.back_end.config.prior_query.spacing
        run.prior_query = make_prior_query(prior, dataset, spacing, run.config.window_size, run.clock)
    try:
        for position, window_input in enumerate(window_inputs(dataset, prior, run.config, run.clock)):
            with run.clock.phase("map"):
                if keeper.found is not None and position < keeper.found.num_inputs:
                    replay_input(run, window_input, keeper.found, is_last=position + 1 == keeper.found.num_inputs)
                else:
                    integrate_input(run, window_input)
            keeper.keep(run, position + 1)
            yield from window_input.raw
        keeper.save()
        if run.saved is not None and run.state is None:
            raise ValueError(not_found_message(run))
        drop_unjoined_submaps(run)
        if run.back_end is not None and not run.is_fixed:
            with run.clock.phase("back_end"):
                finish_back_end(run)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to show
            keeper.save()
        drop_unjoined_submaps(run)
        raise
    finally:  # what an interrupted run leaves has the same unit
        with_first_frame(run)
        rescale_run(run)


def integrate_input(run: MappingRun, window_input: WindowInput) -> None:
    """Integrate one input into the map of `run`, and record what became of its frames."""
    timer = Timer(run.clock)
    match window_input.prediction:
        case None:
            record_lost(run, window_input)
            return
        case FirstWindow() as first if run.saved is None:
            prepare_step(first, run.camera, run.config)
            run.state, run.config = start(first, run.camera, run.config)
            record_start(run, window_input, seconds_of(window_input, timer))
        case prediction:
            if isinstance(prediction, FirstWindow):
                prepare_step(prediction, run.camera, run.config)
            before, new = run.state, start_submap(run, window_input)
            if new is not None:
                run.state, run.config = new
                record_new_submap(run, window_input, seconds_of(window_input, timer))
                enter_submap(run, window_input, before)
            elif not _integrate_step(run, window_input, timer):
                return
    if run.back_end is not None and not run.is_fixed:
        with run.clock.phase("back_end"):
            update_back_end(run, window_input)


def _integrate_step(run: MappingRun, window_input: WindowInput, timer: Timer) -> bool:
    """Run one step and record it; return False where the camera has no pose yet."""
    info, location = step_or_relocalize(run, window_input, step_prediction(run, window_input))
    if info is None:
        record_lost(run, window_input, location)
        return False
    similarity = match_submap(run, window_input, info) if location is None else None
    location = location if similarity is None else JOINED
    record_step(run, window_input, jax.device_get(info), seconds_of(window_input, timer), location, similarity)
    reanchor_prior(run, window_input)
    return True


def step_or_relocalize(
    run: MappingRun, window_input: WindowInput, prediction: Prediction
) -> tuple[StepInfo | None, str | None]:
    """Integrate one input by a step; a lost camera is relocalized first, and the step starts at the pose found.

    Where relocalization fails for long the map restarts at the pose that the step has estimated.

    Returns:
        Result of the step, None where the camera has no pose yet; and the outcome of relocalization, None without one.
    """
    state, config, info, location = run.state, run.config, None, None
    if state is not None:
        state, info, config = advance(state, move_prediction(prediction, run.prior_motion), run.camera, config)
    if is_relocalization_due(run, info):
        place, location = relocalize_frame(run.back_end, frame_data(window_input)[0])
        if place is not None:
            is_known = is_related(run, window_input)
            seen = (
                prediction
                if is_known
                else in_structure(prediction, window_input, place_structure(window_input, place.T_world_camera))
            )
            begin, again = relocalized_start(run, seen, place, has_other_unit=not is_known)
            found = advance(begin, again, run.camera, run.config)
            location = rejection(found[1], again, place, run.back_end.config.relocalization) or RELOCALIZED
            if location == RELOCALIZED:
                state, info, config = found
        if location not in (None, RELOCALIZED) and info is not None and is_restart_due(run, window_input, state, info):
            location, (state, config) = RESTARTED, restart_map(state, run.camera, config)
    if run.is_fixed and state is not None:
        state = replace_map(state, run.saved.map, config.submap.map_capacity)
    run.state, run.config = state, config
    return info, location


def reanchor_prior(run: MappingRun, window_input: WindowInput) -> None:
    """Anchor the prior's world at the last frame, if relocalization has found its pose."""
    if run.records[-1].location != RELOCALIZED:
        return
    if is_related(run, window_input):
        run.prior_motion = anchor_motion_of(run.records[-1], step_prediction(run, window_input))
    else:  # the prior continues in a world of its own, which moves with this frame
        run.structure, run.prior_motion = place_structure(window_input, run.records[-1].pose), jaxlie.SE3.identity()


def replay_input(run: MappingRun, window_input: WindowInput, checkpoint: Checkpoint, is_last: bool) -> None:
    """Replay an input from a checkpoint's records; after the last one the run has the checkpoint's state."""
    if isinstance(window_input.prediction, FirstWindow):
        prepare_step(window_input.prediction, run.camera, run.config)
        if run.saved is None:
            run.state, run.config = start(window_input.prediction, run.camera, run.config)
    first = len(run.records)
    for record in checkpoint.records[first : first + len(window_input.frames)]:
        run.records.append(record)
        run.on_record(record)
    if run.records[-1].location == NEW_SUBMAP:
        enter_submap(run, window_input, run.state)
    reanchor_prior(run, window_input)
    if run.state is None and run.records[-1].location == RELOCALIZED:
        run.state = state_in_saved_map(run, as_step_prediction(window_input.prediction))
    if run.back_end is not None and run.state is not None and not run.is_fixed:
        with run.clock.phase("back_end"):
            update_back_end(run, window_input)  # deforms a map that the checkpoint's state replaces
    if is_last:
        run.state, run.inactive, run.config = checkpoint.restored(run.state, run.config)


def seconds_of(window_input: WindowInput, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Add the seconds of the conversion to those of a timer, which `num_sharing` runs share equally."""
    return {name: window_input.seconds.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}
