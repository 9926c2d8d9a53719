"""The pipeline over a sequence: integrate the inputs one by one into a run, and write its log."""

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from emgs_jax.data.base import Dataset
from emgs_jax.device.clock import Timer
from emgs_jax.existence import Seen
from emgs_jax.mapping.atlas import Atlas, set_unjoined_apart
from emgs_jax.mapping.capacity import prepare_step
from emgs_jax.mapping.checkpoint import Keeper
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.event import Event
from emgs_jax.mapping.finalize import end_looks_of, rescale_atlas, with_first_frame, with_sheets_fused
from emgs_jax.mapping.integrate import finish_back_end, integrate, seconds_of
from emgs_jax.mapping.records import FrameRecord, records_of, with_moved_nodes, with_moved_pixels, with_unjoined_apart
from emgs_jax.mapping.run import MappingRun
from emgs_jax.mapping.window_input import RawView, WindowInput, make_prior_query, window_inputs
from emgs_jax.ops.camera import downscale
from emgs_jax.prior.base import Prior


def map_frames(
    run: MappingRun, dataset: Dataset, prior: Prior, keeper: Keeper | None = None
) -> Iterator[tuple[MappingRun, Sequence[FrameRecord], Sequence[RawView]]]:
    """Map a sequence, input by input; `finish_run` completes the last run.

    Args:
        keeper: of the run's checkpoint; if there is one, the run resumes from it.

    Yields:
        The run after an input, the records of its new frames as first estimated, and their raw predictions.

    Raises:
        ValueError: no frame has points and a pose from which a map can start.
    """
    keeper = keeper or Keeper()
    if run.back_end is not None and run.back_end.config.prior_query.is_used:
        spacing = run.back_end.config.prior_query.spacing
        query = make_prior_query(prior, dataset, spacing, run.config.window_size, run.clock)
        run = replace(run, prior_query=query)
    resumed, num_known, placed = run, 0, ()  # inputs that are already mapped, and their records
    if keeper.found is not None:
        resumed, num_known, placed = keeper.found.restored(run), keeper.found.num_inputs, keeper.found.records
    try:
        for number, window in enumerate(window_inputs(dataset, prior, run.config, run.clock), 1):
            if number > num_known:
                with run.clock.phase("map"):
                    run, records = map_input(run, window)
            else:
                records, placed = placed[: len(window.frames)], placed[len(window.frames) :]
                run = resumed if number == num_known else replace(run, records=(*run.records, *records))
            keeper.keep(run, records)
            yield run, records, window.raw
        keeper.save()
    except BaseException:
        with contextlib.suppress(OSError):  # show the first error
            keeper.save()
        raise
    if run.state is None:  # only with a saved map: otherwise a map has started, or no input could start one
        raise ValueError(not_found_message(run))


def not_found_message(run: MappingRun) -> str:
    """Build the error message of a run without any frame relocalized in the saved map, with the reasons."""
    counts = Counter(record.location for record in run.records if record.location is not None)
    reasons = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    return (
        f"none of the {len(run.records)} frames is found in the saved map ({reasons or 'none has points and a pose'}): "
        "take images of the same place, or map it anew without map="
    )


def map_input(run: MappingRun, window: WindowInput) -> tuple[MappingRun, Sequence[FrameRecord]]:
    """Integrate one input into a run and write its log; also return the new records as first estimated."""
    if isinstance(window.prediction, FirstWindow):
        timer = Timer(run.clock)
        prepare_step(window.prediction.views, run.camera, run.config)
        window = replace(window, seconds=seconds_of(window, timer))
    atlas, event = integrate(run.atlas, window, run.prior_query, run.clock)
    records = records_of(window, event)
    return with_outcome(replace(run, records=(*run.records, *records)), atlas, event), records


def with_outcome(run: MappingRun, atlas: Atlas, event: Event) -> MappingRun:
    """Set the atlas of a run with the records of an input, and update the log of earlier frames by it."""
    seen = [*event.seen, *filter(None, [event.info and event.info.seen])]
    if seen:
        run = with_seen(run, seen, int(atlas.state.time) - 1)
    return with_atlas(run, atlas)


def with_seen(run: MappingRun, all_seen: Sequence[Seen], time: int) -> MappingRun:
    """Update the records of earlier frames by what moved in them; `time` is that of the last record's frame."""
    records = run.records
    for seen in all_seen:
        view = downscale(run.camera, run.config.observation.thin)
        records = with_moved_pixels(records, seen, time, (view.height, view.width))
    return replace(run, records=records)


def with_atlas(run: MappingRun, atlas: Atlas) -> MappingRun:
    """Set the atlas of a run, and update the log by the moved nodes."""
    return replace(run, atlas=atlas, records=with_moved_nodes(run.records, run.atlas.graph.nodes, atlas.graph.nodes))


def finish_run(run: MappingRun, is_interrupted: bool = False) -> MappingRun:
    """Complete a run after its last input; an interrupted one gets the mean unit, too, but is not optimized again."""
    time = 0 if run.state is None else int(run.state.time) - 1
    atlas = set_unjoined_apart(run.atlas)
    if len(atlas.submaps) > 1:
        records = with_unjoined_apart(run.records, atlas.graph.nodes, atlas.graph.active)
        run = replace(run, atlas=atlas, records=records)
    run = with_looks_ended(replace(run, atlas=atlas), time)
    if run.back_end is not None and not atlas.is_frozen and not is_interrupted:
        with run.clock.phase("back_end"):
            run = with_atlas(run, finish_back_end(run.atlas, run.prior_query))
    if not run.records:
        return run
    if not is_interrupted:
        run = with_atlas(run, with_sheets_fused(run.atlas))
    first = next((record.pose for record in run.records if record.submap is None), run.records[0].pose)
    atlas, own = with_first_frame(run.atlas, first)
    return replace(with_atlas(run, rescale_atlas(atlas, first)), first_covariance=own)


def with_looks_ended(run: MappingRun, time: int) -> MappingRun:
    """Apply `end_looks` to all submaps of a run after its last input; `time` is that of the last record's frame."""
    for number in run.atlas.submaps:
        atlas, seen = end_looks_of(run.atlas, number)
        run = with_seen(replace(run, atlas=atlas), seen, time)
    return run
