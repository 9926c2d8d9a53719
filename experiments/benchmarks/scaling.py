"""Cost of a step by the size of the map, and by the number of settings that share it."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from omegaconf import DictConfig, OmegaConf

from emgs_jax.mapping.batch import step_states
from emgs_jax.ops.pytree import stack
from emgs_jax.slam import step

from .data import Data, enlarged, first_state, load
from .timing import Candidate, Timing, called, compare, interleaved

FAR = 50.0  # m between copies of the map: none of them is in the submap


def time_settings(data: Data, counts: Sequence[int], repetitions: int) -> Iterator[Timing]:
    """A step of many settings: stacked with vmap, and the step's own executable in turn and on all cores at once."""
    state, config = first_state(data)
    one = called(step, state, data.prediction, data.camera, config)
    for count in counts:
        gates = config.em.max_mahalanobis_sq * jnp.linspace(0.5, 2.0, count)
        configs = [eqx.tree_at(lambda c: c.em.max_mahalanobis_sq, config, gate) for gate in gates]
        stacked = called(step_states, stack([state] * count), data.prediction, data.camera, stack(configs))

        def single(config: Any) -> Any:
            return jax.block_until_ready(one.verb(state, data.prediction, data.camera, config))

        def in_threads(single: Any = single, configs: Any = configs) -> None:
            with ThreadPoolExecutor(os.cpu_count()) as threads:
                list(threads.map(single, configs))

        candidates = {
            f"{count} settings, one after the other": Candidate(partial(_each, single, configs), one.compile_seconds),
            f"{count} settings, {os.cpu_count()} threads": Candidate(in_threads, one.compile_seconds),
            f"{count} settings, vmap": stacked,
        }
        yield from compare(interleaved("sweep", candidates, repetitions), next(iter(candidates)))


def _each(verb: Any, items: Sequence[Any]) -> None:
    for item in items:
        verb(item)


def time_growth(
    config: DictConfig, sizes: Sequence[Sequence[int]], counts: Sequence[int], repetitions: int
) -> Iterator[Timing]:
    """A step with maps of different sizes, all of which show the same Gaussians to the camera."""
    for size in sizes:
        changed = config.copy()
        OmegaConf.update(changed, "dataset.size", list(size))
        data = load(changed)
        state, slam = first_state(data)
        candidates = {}
        for count in counts:
            map = enlarged(state.map, count, FAR)
            capacity = map.weight.shape[0]
            large = replace(slam, submap=replace(slam.submap, map_capacity=capacity))
            whole = eqx.tree_at(lambda s: s.map, state, map)
            name = f"{size[0]}x{size[1]}, {count} Gaussians"
            candidates[name] = called(step, whole, data.prediction, data.camera, large)
            candidates[name].facts["submap_overflow"] = int(candidates[name].call()[1].overflow.submap)
        yield from compare(interleaved("growth", candidates, repetitions), next(iter(candidates)))
