"""Map one sequence into Hydra's folder: `python -m experiments.run dataset=… prior=…`."""

import contextlib
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.config.configure import baseline_configs, build, build_dataset, build_prior, graph_config
from emgs_jax.config.values import check_values
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.device.clock import Clock
from emgs_jax.evaluation.reconstruction import EvaluationConfig
from emgs_jax.io.files import FrameLog, owned
from emgs_jax.io.packages import extra
from emgs_jax.live.camera import RECORDED
from emgs_jax.live.newest import all_closed, end_all
from emgs_jax.mapping.capacity import prepared_beside
from emgs_jax.mapping.checkpoint import CHECKPOINT_FILE, Keeper
from emgs_jax.mapping.convert import to_camera
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.records import FrameRecord, show_records, to_line
from emgs_jax.mapping.run import MappingRun, check_settings, new_run
from emgs_jax.mapping.window_input import RawView
from emgs_jax.prior.base import UP_KEYS, Prior
from emgs_jax.render.densify import DensifyConfig
from emgs_jax.report.page import write_report
from emgs_jax.report.printout import frame_lines, last_words, metrics_table, polish_lines, time_words, why_no_errors
from emgs_jax.runs.back_end import revisit_note
from emgs_jax.runs.dense import center_cloud, dense_map
from emgs_jax.runs.files import claim_folder, save_classes, save_outputs, save_progress
from emgs_jax.runs.finished_run import REPORT_FILE, read_run
from emgs_jax.runs.gathering import Baselines, RawPrior, gather
from emgs_jax.runs.labelling import labelled_map
from emgs_jax.runs.metrics import (
    compared_text,
    describe,
    new_scorer,
    scale_off,
    score_back_end,
    score_baselines,
    score_map,
    score_prior,
    spent,
)
from emgs_jax.runs.polished import OPTAX, polish
from emgs_jax.runs.provenance import described, is_in_metres, is_metric, provenance, signature, write_metrics
from emgs_jax.runs.results import METRICS_FILE, read_metrics
from emgs_jax.runs.snapshot import save_snapshot
from emgs_jax.viewer.live import LiveView, live_view
from emgs_jax.viewer.ros import NewMapError, RosConfig, RosView, ros_view

from .chunks import run_chunks
from .command import command, job_of
from .interrupt import cameras_first
from .shorthand import with_source

ALSO_SAID = "segmentation/miou_percent", "trajectory/scale_off_std"  # beside prior/…, when a run has ended


def run(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Map the sequence of `config`, write every output into `folder` and return the metrics."""
    if config.chunks is not None:
        raise ValueError("chunks= is for emgs run")
    if config.graph and config.baseline:
        raise ValueError(
            "baseline= fuses every frame where it was placed, and graph= moves poses afterwards: use graph=none with it"
        )
    for part in config:  # before images are read
        check_values(config, str(part))
    if config.map is not None and Path(config.map).resolve() == folder.resolve():
        raise ValueError(f"map={config.map} is the folder of this run, too: give hydra.run.dir=ANOTHER")
    with contextlib.ExitStack() as stack:
        stack.enter_context(owned(folder))
        stack.enter_context(all_closed())
        stack.enter_context(cameras_first(end_all))
        clock = stack.enter_context(Clock().watching())
        with clock.phase("setup"):
            slam, evaluation, densify = (build(config, name) for name in ("slam", "evaluation", "densify"))
            check_settings(slam)  # before COLMAP works for minutes
            graph, fused = graph_config(config), baseline_configs(config)
            dataset = build_dataset(config, folder)
            prior = build_prior(config, dataset)
            is_live = dataset.total is None
            if config.map is None:  # a saved map has its own capacity
                num_features = prior.text_features.shape[-1]
                prepared = stack.enter_context(prepared_beside(to_camera(dataset), num_features, slam))
                if is_live:  # the images that come while programs are compiled are lost
                    tqdm.write("compiling before the first image is taken …")
                    prepared()
            prior.keep(folder)
            metre, of_saved = unit_of_map(config.map, prior)
            slam, densify = slam.in_unit(metre), densify.in_unit(metre)
            if metre != 1:
                tqdm.write(f"lengths of slam= and densify= count {metre:.3g} times, for the unit of the map")
            saved = load_saved_map(config.map, config.map_mode, graph, dataset.intrinsics, float(slam.fit.min_std))
            session = new_run(dataset, slam, clock, graph=graph, saved=saved)
            watched = build(config, "view") if config.view else None
            fitting = build(config, "polish") if config.polish else None
            if fitting is not None:
                extra(*OPTAX)
            baselines = Baselines(fused, slam.observation, dataset)
            settings = OmegaConf.to_container(config, resolve=True)
            origin = provenance(settings, dataset, prior.provenance)
            origin |= of_saved | ({"metre": metre} if metre != 1 else {})
            if saved is not None:
                origin["map"] = saved.checksum
            if isinstance(watched, RosConfig):
                words = str(config.dataset.get("source", "")).split()[1:]

                def save(run: MappingRun, is_last: bool) -> Path:
                    return save_snapshot(folder, run, (dataset, prior), origin, RECORDED if is_last else None)

                live = stack.enter_context(ros_view(watched, words, save, has_saved_map=saved is not None))
            else:
                live = stack.enter_context(live_view(watched, session, densify.render, prior, dataset.kept))
            # Frames of a camera do not come again.
            checkpoint = None if "record" in config.dataset else build(config, "checkpoint")
            keeper = Keeper(folder / CHECKPOINT_FILE, checkpoint, signature(origin))
        for note in [*filter(None, [keeper.note]), *claim_folder(folder, keeper.found is not None)]:
            tqdm.write(note)
        keeps_points = dataset.has_ground_truth or densify.points == "own"
        dataset.begin()
        session, raw = _map(session, dataset, prior, (baselines, evaluation, keeps_points), folder, keeper, live)
        if is_live:  # all its frames are known now
            origin["data"] = described(dataset)
        origin["config"] |= {"dataset": dataset.recording() or settings["dataset"]}
        unit = "m" if is_in_metres(origin) else "units"
        metrics, notes = _write(session, raw, dataset, prior, baselines, (evaluation, densify), folder, unit)
        metrics |= describe(session, dataset) | score_back_end(session) | spent(clock) | prior.report()
        metrics |= dataset.report()
        metrics |= scale_off(metrics)
    metrics["provenance"] = origin
    write_metrics(folder / "metrics.json", metrics)
    keeper.drop()
    with clock.phase("report"):
        finished = read_run(folder)
    if fitting is not None:
        with _said(clock, "polish", "fitting splats to the images"):
            try:
                notes = [*notes, *polish_lines(polish(finished, dataset, fitting, densify))]
            except ValueError as error:  # the run itself is finished
                notes = [*notes, f"not polished: {error}"]
    with _said(clock, "report", f"writing {REPORT_FILE}"):
        write_report(finished, dataset)
    if isinstance(live, LiveView):
        notes = [*notes, f"the live view has ended; emgs view {folder} shows the finished run"]
    notes = [*notes, *revisit_note(session.back_end)]
    counts, took = frame_lines(session.records, len(dataset.skipped)), time_words(clock, len(session.records))
    for note in [*counts, *notes, took]:
        tqdm.write(note)
    return metrics


def unit_of_map(map: str | None, prior: Prior) -> tuple[float, dict[str, bool]]:
    """What a metre is in the map, and for its provenance whether it is in metres: a saved map keeps its unit."""
    path = None if map is None else Path(map) / METRICS_FILE
    if path is None or not path.is_file():  # which `load_saved_map` says
        return prior.metre, {}
    block = read_metrics(path, f"give another map= than {map}")["provenance"]
    found = is_in_metres(block)
    if not found and is_metric(prior.provenance.settings):
        tqdm.write(
            f"map={map} has a unit of its own and keeps it: no length is in metres, whatever the prior or scale= says"
        )
    return block.get("metre", 1.0), {"is_metric": found}


@contextlib.contextmanager
def _said(clock: Clock, phase: str, words: str) -> Iterator[None]:
    """A phase of a run that first prints `words`, if any."""
    if words:
        tqdm.write(f"{words} …")
    with clock.phase(phase):
        yield


def _map(
    start: MappingRun,
    dataset: ReadableFrames,
    prior: Prior,
    compared: tuple[Baselines, EvaluationConfig, bool],
    folder: Path,
    keeper: Keeper,
    live: LiveView | RosView | None,
) -> tuple[MappingRun, RawPrior]:
    """Map all frames and log each; return the run and the raw predictions. An interrupted run writes what it has."""
    if keeper.found is not None:
        tqdm.write(f"resuming after frame {len(keeper.found.records)}: earlier frames are only read and predicted")
    run, (baselines, evaluation, keeps_points) = start, compared
    with FrameLog(folder / "frames.jsonl") as log, tqdm(total=dataset.total, unit="frame", desc="mapping") as bar:

        def frames() -> Iterator[tuple[FrameRecord, RawView]]:
            nonlocal run
            with contextlib.closing(map_frames(start, dataset, prior, keeper)) as inputs:
                for run, new, views in inputs:
                    for record in new:
                        log.append(to_line(record) | {"index": dataset.kept[record.index]})
                    show_records(bar, run.records, len(new), dataset.progress_words)
                    for record, view in zip(new, views, strict=True):
                        if live is not None:
                            live.show(run, view.image, dataset.rates)
                        yield record, view

        for index, reason in dataset.skipped.items():
            log.append(to_line(FrameRecord(index, None, None, "skipped", reason)))
        try:
            # Closed, so that an error while gathering ends the mapping before its results are written.
            with contextlib.closing(frames()) as mapped, start.clock.phase("raw_prior"):
                has_truth = any(dataset.pose(index) is not None for index in range(len(dataset)))
                raw = gather(mapped, evaluation, keeps_points, baselines, compared_text(dataset, prior), has_truth)
            run = finish_run(run)
        except NewMapError:  # this one is saved
            raise
        except BaseException:
            with contextlib.suppress(OSError, ValueError):  # the first error is the one to show
                run = finish_run(run, is_interrupted=True)
                save_progress(folder, run)
                if run.state is not None:
                    tqdm.write(f"ended early: what is mapped so far is in {folder}")
                if keeper.path.exists():
                    tqdm.write(f"the same command with hydra.run.dir={folder} resumes there")
            raise
    if live is not None:
        live.show_last(run)
    return run, raw


def _write(
    run: MappingRun,
    raw: RawPrior,
    dataset: ReadableFrames,
    prior: Prior,
    baselines: Baselines,
    configs: tuple[EvaluationConfig, DensifyConfig],
    folder: Path,
    unit: str,
) -> tuple[dict[str, Any], list[str]]:
    """Draw the map, write it and compare it with the truth; the raw prior is scored meanwhile.

    Returns:
        The metrics, and what is to be said of the files.
    """
    clock, (evaluation, densify) = run.clock, configs
    with ThreadPoolExecutor(2, "raw prior") as threads:
        truth = threads.submit(new_scorer, dataset, evaluation, prior, unit == "m")
        of_prior = threads.submit(lambda: score_prior(run, raw, truth.result()))
        with clock.phase("export"):
            save_progress(folder, run)
        with _said(clock, "densify", "drawing the map from the pose of every frame"):
            labelled = labelled_map(run, prior)
            dense = dense_map(run, dataset, densify, evaluation, labelled, own=raw.points)
        with _said(clock, "export", "writing the map, its points, a mesh and the overview"):
            title = f"{dataset.name} {dataset.sequence}, prior {prior.provenance.name}"
            notes = save_outputs(folder, run, dense, densify, title, evaluation.alignment == "sim3", unit)
            save_classes(folder, prior)
        compared = ", ".join(["the map", "the raw prior", *baselines.raw]) if dataset.has_ground_truth else ""
        with _said(clock, "evaluate", compared and f"comparing with the truth: {compared}"):
            scorer, labels = truth.result(), None if labelled is None else labelled.centers
            metrics = score_map(run, dense.cloud, center_cloud(run), labels, scorer) | dense.rendering
            return metrics | of_prior.result() | score_baselines(run, baselines, raw, scorer), notes


def run_and_print(config: DictConfig) -> float:
    """Run, print the results, and return the trajectory error (inf without one)."""
    folder, problems = Path(HydraConfig.get().runtime.output_dir), []
    if config.chunks is None:
        metrics = run(config, folder)
    else:
        metrics, problems = run_chunks(config, folder, job_of("config", run_and_print))
    print(metrics_table(metrics) if "trajectory/num_frames" in metrics else why_no_errors(metrics))
    for key, value in metrics.items():
        if value is not None and key not in UP_KEYS and (key.startswith("prior/") or key in ALSO_SAID):
            print(f"{key} {value:.4g}")
    print(f"{last_words(metrics)}everything is in {folder}, {REPORT_FILE} shows it")
    if problems:
        again = f"the same command with hydra.run.dir={folder} runs these again, and joins them"
        raise ValueError("\n       ".join([*problems, again]))
    error = metrics.get("trajectory/ate_sim3_m")
    return math.inf if error is None else error


@command("config", rewritten=with_source)
def main(config: DictConfig) -> float:
    """Run, and return the trajectory error for Hydra's sweepers."""
    return run_and_print(config)


if __name__ == "__main__":
    main()
