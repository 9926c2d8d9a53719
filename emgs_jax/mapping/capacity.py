"""Capacity of maps on the host: executables for each size, and doubling when a map or submap is full."""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from threading import Event, Lock
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.device.arrays import on_device
from emgs_jax.device.compilation import compile_all
from emgs_jax.gaussian_map import GaussianMap, empty_map, grow, insert
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.motion import no_looks
from emgs_jax.observation import Observation, Prediction, no_covariance, observe, transform, unknown_scale
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.executable import calling
from emgs_jax.ops.precision import full_precision
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import Overflow, SlamConfig, SlamState, StepInfo, init_state, step

_insert = eqx.filter_jit(insert)
_preparing = Lock()


def start(
    first: FirstWindow, camera: Camera, config: SlamConfig, init: Callable = init_state
) -> tuple[SlamState, SlamConfig]:
    """Make the map of the first window; return the state, and the config with sufficient capacity.

    Args:
        camera: of the full images.
        config: all stages; its capacities are the first to try.
        init: `init_state`, or its form for stacked configs.
    """
    state, overflow = init(first.views, first.T_world_views, camera, config)
    while np.any(overflow):
        config = grow_capacities(config, _of_map(overflow))
        state, overflow = init(first.views, first.T_world_views, camera, config)
    return state, config


def restart_map(state: SlamState, camera: Camera, config: SlamConfig) -> tuple[SlamState, SlamConfig]:
    """Restart the map from its last frame, at that frame's pose, like a first window with this one view.

    This is for a camera that no longer fits the map and cannot be relocalized in it. All Gaussians stay. The frame's
    pose is exact relative to the new ones.

    Args:
        state: after the step of that frame, which has points.
        camera: of the full images.
        config: all stages; returned with more capacity if the map needs it.
    """
    T = state.T_world_previous
    view = transform(T.inverse(), state.previous, jnp.ones(()))
    first = FirstWindow(*jax.tree.map(lambda leaf: leaf[None], (view, T, no_covariance(), unknown_scale())))
    alone, _ = start(first, camera, config)
    new = replace(alone.map, birth=jnp.full_like(alone.map.birth, state.time - 1))
    map, config = add_map(state.map, new, config)
    estimate = replace(state.estimate, covariance=jnp.zeros_like(state.estimate.covariance))
    return replace(state, map=map, estimate=estimate), config


def add_map(map: GaussianMap, other: GaussianMap, config: SlamConfig) -> tuple[GaussianMap, SlamConfig]:
    """Insert all Gaussians of a map into another; return that map, and the config with sufficient capacity."""
    both, _, overflow = _insert(map, other)
    while overflow > 0:
        config = grow_capacities(config, _of_map(overflow))
        both, _, overflow = _insert(grow(map, config.submap.map_capacity), other)
    return both, config


def prepare_step(
    views: Observation, camera: Camera, config: SlamConfig, is_wanted: Callable[[], bool] = lambda: True
) -> None:
    """Compile the executables of `step` in parallel on all cores; those that exist cost little.

    Args:
        views: observations of the sequence, stacked, or their shapes.
        camera: of the full images.
        is_wanted: called before each executable; False stops the rest.
    """
    calls: list[tuple[Callable, tuple]] = []

    def note(executable: Callable, *arguments: Any) -> Any:
        calls.append((executable, arguments))
        return _zeros(eqx.filter_eval_shape(executable, *arguments))

    view = _zeros(jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), views))
    pose, poses = (jaxlie.SE3(on_device(np.eye(1, 7, dtype=np.float32).repeat(n, 0).squeeze())) for n in (1, 3))
    unknown = on_device(np.bool_(False))
    prediction = Prediction(
        current=view,
        previous=view,
        T_world_views=poses,
        T_world_anchor=pose,
        pose_covariance=no_covariance(),
        scale_std=unknown_scale(),
        has_newest=unknown,
        is_repeat=unknown,
    )
    map = _zeros(jax.eval_shape(lambda: empty_map(config.submap.map_capacity, view.features.shape[-1])))
    looks = _zeros(jax.eval_shape(lambda: no_looks(view, config.motion)))
    state = SlamState(map, view, pose, _zeros(jax.eval_shape(exact_estimate)), on_device(np.int32(0)), looks)
    with _preparing:  # a compilation that began beside the prediction may still run
        with calling(note):
            step(state, prediction, camera, config)
        compile_all([partial(_compile, *noted) for noted in calls], is_wanted)


@contextlib.contextmanager
def prepared_beside(camera: Camera, num_features: int, config: SlamConfig) -> Iterator[Callable[[], None]]:
    """Run `prepare_step` in the background of a block that reads and predicts the first frames.

    Yields a function that waits until it has ended.

    Args:
        camera: of the full images.
        num_features: width of the prior's features. If it turns out different, the step is compiled when it first runs;
            any error appears there, too.
    """
    h, w = camera.height, camera.width
    sizes = ((h, w, 3), "float32"), ((h, w, 3), "float32"), ((h, w, num_features), "float32"), ((h, w), "float32")
    image = (jax.ShapeDtypeStruct((1, *size), kind) for size, kind in (*sizes, ((h, w), "bool")))
    views = jax.eval_shape(jax.vmap(lambda *arrays: observe(*arrays, config.observation)), *image)
    ended = Event()
    with ThreadPoolExecutor(1, "compilation") as thread:
        preparing = thread.submit(prepare_step, views, camera, config, lambda: not ended.is_set())
        try:
            yield partial(wait, [preparing])
        finally:
            ended.set()


@full_precision  # as inside `step`; otherwise it is another program
def _compile(executable: Any, arguments: tuple) -> None:
    executable.lower(*arguments).compile()


def _of_map(overflow: jax.Array) -> Overflow:
    """Make the overflow of a map alone."""
    nothing = jnp.zeros_like(overflow)
    return Overflow(map=overflow, submap=nothing, tiles=nothing)


def _zeros(shapes: Any) -> Any:
    """Replace shapes by arrays of zeros from NumPy, which compiles nothing."""
    is_shape = lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct)  # noqa: E731
    return jax.tree.map(lambda leaf: on_device(np.zeros(leaf.shape, leaf.dtype)) if is_shape(leaf) else leaf, shapes)


def advance(
    state: SlamState, prediction: Prediction, camera: Camera, config: SlamConfig, step: Callable = step
) -> tuple[SlamState, StepInfo, SlamConfig]:
    """Run one step; if a map or submap is full, double its capacity and repeat the frame.

    The result is the same as with the larger capacity from the start. Splats beyond the tiles' capacity are only
    counted; where they are missing, refinement makes new Gaussians. `step` is `slam.step`, or its form for stacked
    states.
    """
    new, info = step(state, prediction, camera, config)
    while np.any(info.overflow.map) or np.any(info.overflow.submap):
        config = grow_capacities(config, info.overflow)
        if config.submap.map_capacity > state.map.weight.shape[-1]:
            state = eqx.tree_at(lambda s: s.map, state, grow(state.map, config.submap.map_capacity))
        new, info = step(state, prediction, camera, config)
    return new, info, config


def grow_capacities(config: SlamConfig, overflow: Overflow) -> SlamConfig:
    """Double the capacities that overflowed; each new size compiles once."""
    submap = config.submap
    map_factor, submap_factor = (2 if np.any(lost) else 1 for lost in (overflow.map, overflow.submap))
    capacities = submap.map_capacity * map_factor, submap.submap_capacity * submap_factor
    return replace(config, submap=replace(submap, map_capacity=capacities[0], submap_capacity=capacities[1]))
