"""The stages of one step, each by itself, the whole step, and a step of many settings."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from emgs_jax.em import e_step, m_step, owners, precision
from emgs_jax.existence import Look, fusion_evidence, merge_duplicates, update_existence
from emgs_jax.gaussian_map import confirmed, insert, new_map, select_submap, write_back
from emgs_jax.gaussians import cluster, spacing
from emgs_jax.localization import localize_coarse, localize_fine
from emgs_jax.mapping.batch import step_states
from emgs_jax.observation import observe, transform
from emgs_jax.ops.camera import downscale
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.pytree import stack
from emgs_jax.refinement import refine
from emgs_jax.render.composite import render
from emgs_jax.slam import step
from emgs_jax.splitting import split

from .data import Data, first_state
from .timing import Candidate, Timing, called, compare, interleaved


def time_stages(data: Data, repetitions: int) -> list[Timing]:
    """Compile every stage for what the stages before it give, then time all in turns."""
    candidates: dict[str, Candidate] = {}

    def stage(name: str, verb: Callable, *arguments: Any) -> Any:
        candidates[name] = called(eqx.filter_jit(verb), *arguments)
        return candidates[name].call()

    state, config = first_state(data)
    prediction, thin = data.prediction, config.observation.thin
    camera = downscale(data.camera, thin)
    raw = data.raw
    arrays = raw.points[0], data.images[0] / 255.0, raw.features[0], raw.confidence[0]
    stage(
        "observe", observe, *(jnp.asarray(x, jnp.float32) for x in arrays), jnp.asarray(raw.mask[0]), config.observation
    )
    before = state.previous, state.T_world_previous
    coarse = stage("localize, coarse", localize_coarse, prediction, *before, camera, config.localization)
    guess = transform(coarse.T_world_camera, prediction.current, coarse.scale)
    clouds = state.previous, guess
    submap, rows, _ = stage("submap", select_submap, state.map, clouds, config.submap)
    fine = prediction.current, confirmed(submap), coarse, config.localization
    T, aligned, localization = stage("localize, fine", localize_fine, *fine)
    noise = localization.noise[:, None] * (aligned.points - T.translation())
    steps, _ = stage("E-step", e_step, submap.gaussians, aligned, noise, config.em)
    stage("M-step", m_step, submap.gaussians, aligned, precision(noise, config.em), steps, config.em)
    num_rows = spacing(data.camera, thin, config.fit)
    owned = owners(steps, rows.shape[0])
    stage("split", split, submap, aligned, noise, owned, num_rows, config.splitting)
    rest = eqx.tree_at(lambda o: o.valid, aligned, aligned.valid & ~steps.is_fused)
    order = morton_order(camera.height, camera.width)
    candidates_new, weight = stage("new Gaussians", cluster, rest, order, num_rows, config.fit)
    submap, fresh, _ = stage("refine", refine, submap, candidates_new, T, camera, config.refinement)
    drawn = submap.gaussians, submap.gaussians.colors, T, camera, config.refinement.render
    stage("render", render, *drawn)
    look = Look(aligned, T, camera, localization.depth_noise), config.existence
    _, is_seen = stage("judge", update_existence, state.map, fusion_evidence(state.map, submap, rows), *look)
    seen = is_seen[jnp.minimum(rows, is_seen.shape[0] - 1)]
    stage("join layers", merge_duplicates, submap, seen, T.translation(), localization.depth_noise, config.existence)
    add = lambda m, s, r, f, w: insert(write_back(m, s, r), new_map(f, w, jnp.zeros(()), jnp.asarray(0)))  # noqa: E731
    stage("insert", add, state.map, submap, rows, fresh, weight)
    candidates["whole step"] = called(step, state, prediction, data.camera, config)
    return interleaved("stages", candidates, repetitions)


def time_settings(data: Data, counts: Sequence[int], repetitions: int) -> Iterator[Timing]:
    """A step of many settings: the step's own executable in turn and on all cores at once, and stacked with vmap."""
    state, config = first_state(data)
    compile_seconds = called(step, state, data.prediction, data.camera, config).compile_seconds
    for count in counts:
        gates = config.em.max_mahalanobis_sq * jnp.linspace(0.5, 2.0, count)
        configs = [eqx.tree_at(lambda c: c.em.max_mahalanobis_sq, config, gate) for gate in gates]

        def on(num_threads: int, configs: Sequence[Any] = configs) -> Callable[[], None]:
            def call() -> None:
                with ThreadPoolExecutor(num_threads) as threads:
                    list(
                        threads.map(
                            lambda c: jax.block_until_ready(step(state, data.prediction, data.camera, c)), configs
                        )
                    )

            return call

        candidates = {
            f"{count} settings, one after the other": Candidate(on(1), compile_seconds),
            f"{count} settings, {os.cpu_count()} threads": Candidate(on(os.cpu_count() or 1), compile_seconds),
            f"{count} settings, vmap": called(
                step_states, stack([state] * count), data.prediction, data.camera, stack(configs)
            ),
        }
        yield from compare(interleaved("sweep", candidates, repetitions), next(iter(candidates)))
