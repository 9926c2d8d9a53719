"""A sequence through the whole pipeline: what each input does to a run."""

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
from emgs_jax.running.checkpoint import Checkpoint, Keeper
from emgs_jax.running.clock import Clock, Timer
from emgs_jax.running.compilation import use_compilation_cache
from emgs_jax.running.configure import RunConfig, build_dataset, build_prior
from emgs_jax.running.convert import FirstWindow
from emgs_jax.running.correction import correct, finish
from emgs_jax.running.first_frame import with_first_frame
from emgs_jax.running.growth import advance, begin_anew, prepare, start
from emgs_jax.running.inputs import Input, RawView, inputs
from emgs_jax.running.locating import (
    anchored_by,
    as_prediction,
    begun,
    found_at,
    is_missing,
    is_to_begin_anew,
    look_for,
    moved,
    nowhere,
    refusal,
    with_map,
)
from emgs_jax.running.places import load_saved
from emgs_jax.running.record import (
    ANEW,
    FOUND,
    JOINED,
    SEGMENT,
    FrameRecord,
    MappingRun,
    new_run,
    record_lost,
    record_segment,
    record_start,
    record_step,
)
from emgs_jax.running.revisiting import asking
from emgs_jax.running.segments import (
    begun_segment,
    enter,
    in_structure,
    is_related,
    leave_out,
    meeting,
    placed_by,
    predicted,
)
from emgs_jax.running.unit import in_own_unit
from emgs_jax.running.untracked import alarm
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
    saved = load_saved(
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
    """Move the bar by one frame, and say what became of it, the last of `records`; a line where many do not fit."""
    said = None if bar.disable else alarm(records)
    if said is not None:
        tqdm.write(said)
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
    if run.back_end is not None and run.back_end.config.revisit.is_asked:
        spacing = run.back_end.config.revisit.spacing
        run.ask = asking(prior, dataset, spacing, run.config.window_size, run.clock)
    try:
        for position, given in enumerate(inputs(dataset, prior, run.config, run.clock)):
            with run.clock.phase("map"):
                if keeper.found is not None and position < keeper.found.num_inputs:
                    repeat(run, given, keeper.found, is_last=position + 1 == keeper.found.num_inputs)
                else:
                    take(run, given)
            keeper.keep(run, position + 1)
            yield from given.raw
        keeper.save()
        if run.saved is not None and run.state is None:
            raise ValueError(nowhere(run))
        leave_out(run)
        if run.back_end is not None and not run.is_fixed:
            with run.clock.phase("back_end"):
                finish(run)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to show
            keeper.save()
        leave_out(run)
        raise
    finally:  # what an interrupted run leaves has the same unit
        with_first_frame(run)
        in_own_unit(run)


def take(run: MappingRun, given: Input) -> None:
    """Integrate one input into the map of `run`, and record what became of its frames."""
    timer = Timer(run.clock)
    match given.taken:
        case None:
            record_lost(run, given)
            return
        case FirstWindow() as first if run.saved is None:
            prepare(first, run.camera, run.config)
            run.state, run.config = start(first, run.camera, run.config)
            record_start(run, given, spent(given, timer))
        case taken:
            if isinstance(taken, FirstWindow):
                prepare(taken, run.camera, run.config)
            before, new = run.state, begun_segment(run, given)
            if new is not None:
                run.state, run.config = new
                record_segment(run, given, spent(given, timer))
                enter(run, given, before)
            elif not go_on(run, given, timer):
                return
    if run.back_end is not None and not run.is_fixed:
        with run.clock.phase("back_end"):
            correct(run, given)


def go_on(run: MappingRun, given: Input, timer: Timer) -> bool:
    """One step, recorded; False where the camera has no place yet."""
    info, location = integrate(run, given, predicted(run, given))
    if info is None:
        record_lost(run, given, location)
        return False
    similarity = meeting(run, given, info) if location is None else None
    location = location if similarity is None else JOINED
    record_step(run, given, jax.device_get(info), spent(given, timer), location, similarity)
    anchor_anew(run, given)
    return True


def integrate(run: MappingRun, given: Input, prediction: Prediction) -> tuple[StepInfo | None, str | None]:
    """Integrate one input by a step; a lost camera is relocalized first, and the step starts at the pose found.

    Where relocalization fails for long the map restarts at the pose that the step has estimated.

    Returns:
        Result of the step, None where the camera has no pose yet; and the outcome of relocalization, None without one.
    """
    state, config, info, location = run.state, run.config, None, None
    if state is not None:
        state, info, config = advance(state, moved(prediction, run.prior_motion), run.camera, config)
    if is_missing(run, info):
        place, location = look_for(run, given)
        if place is not None:
            is_known = is_related(run, given)
            seen = prediction if is_known else in_structure(prediction, given, placed_by(given, place.T_world_camera))
            begin, again = found_at(run, seen, place, has_other_unit=not is_known)
            found = advance(begin, again, run.camera, run.config)
            location = refusal(found[1], again, place, run.back_end.config.location) or FOUND
            if location == FOUND:
                state, info, config = found
        if location not in (None, FOUND) and info is not None and is_to_begin_anew(run, given, state, info):
            location, (state, config) = ANEW, begin_anew(state, run.camera, config)
    if run.is_fixed and state is not None:
        state = with_map(state, run.saved.map, config.submap.map_capacity)
    run.state, run.config = state, config
    return info, location


def anchor_anew(run: MappingRun, given: Input) -> None:
    """From the last frame on the prior's world is where that was found, if it was."""
    if run.records[-1].location != FOUND:
        return
    if is_related(run, given):
        run.prior_motion = anchored_by(run.records[-1], predicted(run, given))
    else:  # the prior has gone on in a frame of its own, which follows this one where the back end moves it
        run.structure, run.prior_motion = placed_by(given, run.records[-1].pose), jaxlie.SE3.identity()


def repeat(run: MappingRun, given: Input, checkpoint: Checkpoint, is_last: bool) -> None:
    """Let a checkpoint stand for what `take` did of an input; after the last the run is where it was stopped."""
    if isinstance(given.taken, FirstWindow):
        prepare(given.taken, run.camera, run.config)
        if run.saved is None:
            run.state, run.config = start(given.taken, run.camera, run.config)
    first = len(run.records)
    for record in checkpoint.records[first : first + len(given.frames)]:
        run.records.append(record)
        run.on_record(record)
    if run.records[-1].location == SEGMENT:
        enter(run, given, run.state)
    anchor_anew(run, given)
    if run.state is None and run.records[-1].location == FOUND:
        run.state = begun(run, as_prediction(given.taken))
    if run.back_end is not None and run.state is not None and not run.is_fixed:
        with run.clock.phase("back_end"):
            correct(run, given)  # moves the map of the first window, in which nobody looks
    if is_last:
        run.state, run.aside, run.config = checkpoint.restored(run.state, run.config)


def spent(given: Input, timer: Timer, num_sharing: int = 1) -> Mapping[str, float]:
    """Seconds of the conversion, and of what the timer saw as if the runs that shared it had been by themselves."""
    return {name: given.spent.get(name, 0.0) + seconds / num_sharing for name, seconds in timer.read().items()}
