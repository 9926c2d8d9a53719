"""From the words of a command line to a mapped sequence: `map_sequence(load_config("dataset=images", …))`."""

from dataclasses import dataclass, replace
from typing import Any

from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from emgs_jax.back_end.saved_map import load_saved_map
from emgs_jax.back_end.state import BackEndConfig
from emgs_jax.config.configure import build, build_dataset, build_prior, check_added, compose, graph_config, message_of
from emgs_jax.device.clock import Clock
from emgs_jax.device.settings import use_compilation_cache
from emgs_jax.evaluation.reconstruction import EvaluationConfig
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.records import show_records
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.render.densify import DensifyConfig
from emgs_jax.slam import SlamConfig, Stage


@dataclass(frozen=True)
class RunConfig:
    """A sequence and how to map it.

    Args:
        settings: all keys as plain values; the other fields are built from them.
        densify: which pixels of a rendered view become points.
        evaluation: the protocol of the comparison with the truth.
    """

    settings: dict[str, Any]
    slam: SlamConfig
    densify: DensifyConfig
    evaluation: EvaluationConfig
    graph: BackEndConfig | None = None


def load_config(*overrides: str, name: str = "config") -> RunConfig:
    """Build the config from the words of a command line: `load_config("dataset=images", "dataset.root=video.mp4")`.

    Args:
        overrides: as for `emgs run`; `emgs run --help` lists them.

    Raises:
        ValueError: an override names no key or option; the message suggests similar ones.
    """
    config = compose(*overrides, name=name)
    check_added(overrides, name)
    try:
        slam, densify, evaluation = (build(config, part) for part in ("slam", "densify", "evaluation"))
        graph = graph_config(config)
        settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except InstantiationException as error:
        raise ValueError(message_of(error)) from error
    except OmegaConfBaseException as error:  # a value that others refer to is missing or has the wrong type
        raise ValueError(f"{' '.join(overrides)}: {message_of(error)}") from error
    return RunConfig(settings=settings, slam=slam, densify=densify, evaluation=evaluation, graph=graph)


def map_sequence(config: RunConfig, show_progress: bool = True, **stages: Stage) -> MappingRun:
    """Map the sequence of a config. The returned run holds the map, and a record with a pose for every frame.

    Args:
        stages: functions that replace stages of a step, by the names of `slam.Stages`: `em_update=mine`.

    Raises:
        ValueError: the data set, the prior or a frame cannot be used.
    """
    settings, slam = OmegaConf.create(config.settings), config.slam
    slam = replace(slam, stages=slam.stages._replace(**stages))
    use_compilation_cache(settings.compilation_cache)
    dataset = build_dataset(settings)
    prior = build_prior(settings, dataset)
    slam = slam.in_unit(prior.metre)
    saved = load_saved_map(settings.map, settings.map_mode, config.graph, dataset.intrinsics, float(slam.fit.min_std))
    with (
        Clock().watching() as clock,
        tqdm(total=dataset.total, unit="frame", desc="mapping", disable=not show_progress) as bar,
    ):
        run = start = new_run(dataset, slam, clock, graph=config.graph, saved=saved)
        for run, new, _ in map_frames(start, dataset, prior):
            show_records(bar, run.records, len(new), dataset.progress_words)
        return finish_run(run)
