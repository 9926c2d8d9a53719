"""Fit splats and poses to the frames: Adam, one frame a step, in an order given by the seed."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.data.spool import Spool
from emgs_jax.io.npz import load_headed, save_headed
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.ranges import number
from emgs_jax.polish.splats import Anchors, Appearance, LossConfig, Shot, initial, loss

POSE_RATE = 0.3  # Adam's learning rate for frames placed on finished splats, in standard deviations
Result = TypeVar("Result")


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates for each part of `Appearance`, and for the poses, in standard deviations of each."""

    colors: float = number(0.03, low=0, high=10)
    logit: float = number(0.05, low=0, high=10)
    log_std: float = number(0.05, low=0, high=10)
    turn: float = number(0.02, low=0, high=10)
    shift: float = number(0.1, low=0, high=10)
    pose: float = number(0.15, low=0, high=10)


@dataclass(frozen=True)
class PolishConfig:
    """How splats are made and fitted.

    Args:
        pixels_per_splat: pixels per splat in the frame that makes it.
        held_out_every: every such frame is never fitted, beginning with the first one.
        steps: of Adam, one frame each.
        final_rate: factor on the learning rates at the last step; they decay exponentially.
        opacity: initial opacity of a splat.
        min_opacity: splats below this at the end are removed.
        every: steps between the states from which a stopped fit resumes.
        seed: of the order of the frames.
        exposures: share of the log-ratio between a frame's brightness and its splats' that becomes its own gain; 0: all
            frames have the same. With 1, gains and colours drift against each other.
        poses: fit the poses of the fitted frames, too; the others are then placed on the finished splats.
        pose_steps: of Adam, for each frame that is placed on finished splats.
        rates: learning rates.
        loss: weights of the loss.
    """

    rates: Rates = field(default_factory=Rates)
    loss: LossConfig = field(default_factory=LossConfig)
    pixels_per_splat: int = number(4, low=1, high=10_000)
    held_out_every: int = number(8, low=2, high=1_000_000)
    steps: int = number(400, low=0, high=10_000_000)
    final_rate: float = number(0.1, low=1e-6, high=1)
    opacity: float = number(0.9, low=0.01, high=0.99)
    min_opacity: float = number(0.05, low=0, high=1)
    every: int = number(100, low=1, high=10_000_000)
    seed: int = number(0, low=0, high=2**31 - 1)
    pose_steps: int = number(30, low=0, high=10_000)
    exposures: float = number(0.8, low=0, high=1)
    poses: bool = True


def is_held_out(row: int, config: PolishConfig) -> bool:
    """Test whether the frame of this row is held out for the comparison."""
    return row % config.held_out_every == 0


class Views(NamedTuple):
    """Frames to which splats are fitted, or that are placed on them.

    Args:
        targets: `Shot.target` of each frame, (h, w, 4).
        poses: T_world_camera of each, (m, 4, 4).
        spreads: (m, 6, 6); a pose may become T Exp(spread u); 0 for a fixed pose.
        gains: initial `Shot.gain` of each, (m, 3).
    """

    targets: Spool
    poses: np.ndarray
    spreads: np.ndarray
    gains: np.ndarray


class State(NamedTuple):
    """State of a fit: parameters and Adam's moments."""

    fitted: Appearance
    offsets: Float[Array, "m 6"]  # of the poses, in spreads
    gains: Float[Array, "m 3"]  # of each frame, when it was last seen
    moments: Any
    pose_moments: Any  # of each frame separately, as a step sees one frame


def fit(
    anchors: Anchors,
    colors: np.ndarray,
    views: Views,
    camera: Camera,
    config: PolishConfig,
    path: Path,
    on_step: Callable[[int, float], None] = lambda step, psnr: None,
) -> tuple[Appearance, Views]:
    """Fit the splats' appearance to frames; the same call resumes a stopped fit from `path`.

    Args:
        anchors: initial splats.
        colors: initial colours, (n, 3).
        path: of the file from which a stopped fit resumes; removed at the end.
        on_step: called with the number of each step, and the PSNR (dB) of its frame before it.

    Returns:
        The splats' appearance, and the frames with their fitted poses and gains.
    """
    import optax  # an extra

    adam = optax.scale_by_adam(eps=1e-15)  # as 3DGS
    fitted = initial(jnp.asarray(colors, jnp.float32), jnp.float32(config.opacity))
    offsets, gains = jnp.zeros((len(views.poses), 6)), jnp.asarray(views.gains, jnp.float32)
    state = State(fitted, offsets, gains, adam.init(fitted), jax.vmap(adam.init)(offsets))

    each = config.rates
    rates = (
        ("colors", each.colors),
        ("logit", each.logit),
        ("log_std", each.log_std),
        ("turn", each.turn),
        ("shift", each.shift),
    )

    @eqx.filter_jit
    @full_precision
    def step(state: State, anchors: Anchors, view: View, decay: Array, terms: LossConfig):
        offset, pose_moments = jax.tree.map(lambda x: x[view.row], (state.offsets, state.pose_moments))

        def total(fitted: Appearance, offset: Float[Array, "6"]):
            shot = Shot(view.target, moved(view, offset), state.gains[view.row])
            return loss(fitted, anchors, shot, camera, terms)

        (_, misfit), (slope, turn) = jax.value_and_grad(total, (0, 1), has_aux=True)(state.fitted, offset)
        change, moments = adam.update(slope, state.moments)
        move, pose_moments = adam.update(turn, pose_moments)
        parts = {name: getattr(state.fitted, name) - decay * rate * getattr(change, name) for name, rate in rates}
        of_frame = offset - decay * each.pose * move, misfit.gain**config.exposures, pose_moments
        of_all = state.offsets, state.gains, state.pose_moments
        offsets, gains, all_moments = jax.tree.map(lambda x, y: x.at[view.row].set(y), of_all, of_frame)
        return (State(Appearance(**parts), offsets, gains, moments, all_moments), misfit.mean_sq), misfit.overflow

    terms, signature = config.loss, _signature(anchors, colors, config)
    first, state = _read(path, state, signature)
    for number_ in range(first, config.steps):
        epoch, place = divmod(number_, len(views.poses))
        row = int(np.random.default_rng((config.seed, epoch)).permutation(len(views.poses))[place])
        decay = jnp.float32(config.final_rate ** (number_ / max(config.steps - 1, 1)))
        (state, error), terms = with_room(partial(step, state, anchors, view_of(views, row), decay), terms)
        on_step(number_, -10.0 * float(np.log10(max(float(error), 1e-12))))
        if (number_ + 1) % config.every == 0:
            _write(path, number_ + 1, state, signature)
    path.unlink(missing_ok=True)
    gains = np.asarray(state.gains, np.float64)
    return state.fitted, views._replace(poses=placed(views, state.offsets), gains=gains)


def place_on_splats(
    anchors: Anchors, fitted: Appearance, views: Views, camera: Camera, config: PolishConfig
) -> np.ndarray:
    """Fit the poses of frames to fixed splats; return T_world_camera of each, (m, 4, 4)."""
    import optax  # an extra

    adam, terms = optax.scale_by_adam(eps=1e-15), config.loss

    @eqx.filter_jit
    @full_precision
    def step(offset: Float[Array, "6"], moments: Any, view: View, rate: Array, splats: tuple, terms: LossConfig):
        def total(offset: Float[Array, "6"]):
            return loss(*splats, Shot(view.target, moved(view, offset), view.gain), camera, terms)

        slope, misfit = jax.grad(total, has_aux=True)(offset)
        move, moments = adam.update(slope, moments)
        return (offset - rate * move, moments), misfit.overflow

    offsets = []
    for row in range(len(views.poses)):
        view, offset = view_of(views, row), jnp.zeros(6)
        moments = adam.init(offset)
        for number_ in range(config.pose_steps):
            rate = jnp.float32(POSE_RATE * config.final_rate ** (number_ / max(config.pose_steps - 1, 1)))
            call = partial(step, offset, moments, view, rate, (fitted, anchors))
            (offset, moments), terms = with_room(call, terms)
        offsets.append(offset)
    return placed(views, jnp.stack(offsets))


def with_room(call: Callable[[LossConfig], tuple[Result, Array | int]], terms: LossConfig) -> tuple[Result, LossConfig]:
    """Double the capacity of the tiles' lists and repeat the call until all splats fit; return result and terms.

    Args:
        call: returns its result and how many splats did not fit.
        terms: with the current capacity.
    """
    while True:
        result, overflow = call(terms)
        if not int(overflow):
            return result, terms
        render = replace(terms.render, tile_capacity=2 * terms.render.tile_capacity)
        terms = replace(terms, render=render)


class View(NamedTuple):
    """One frame of `Views`, on the device; fields in its order."""

    row: Array
    target: Float[Array, "h w 4"]
    pose: Float[Array, "4 4"]
    spread: Float[Array, "6 6"]
    gain: Float[Array, "3"]


def view_of(views: Views, row: int) -> View:
    """Take the frame of this row."""
    target, *others = (jnp.asarray(x[row], jnp.float32) for x in (views.targets, *views[1:]))
    return View(jnp.int32(row), target, *others)


def moved(view: View, offset: Float[Array, "6"]) -> jaxlie.SE3:
    """Compute the pose T Exp(spread u)."""
    return jaxlie.SE3.from_matrix(view.pose) @ jaxlie.SE3.exp(view.spread @ offset)


@full_precision
def placed(views: Views, offsets: Float[Array, "m 6"]) -> np.ndarray:
    """Compute T_world_camera of all frames, (m, 4, 4) float64; frames without a spread stay to the bit."""
    xi = jnp.asarray(np.einsum("mij,mj->mi", views.spreads, np.asarray(offsets, np.float64)), jnp.float32)
    return views.poses @ np.asarray(jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(xi), np.float64)


def _signature(anchors: Anchors, colors: np.ndarray, config: PolishConfig) -> str:
    """Compute a digest of the initial splats and all settings."""
    settings = replace(config, loss=jax.tree.map(float, config.loss))  # its arrays would be shown only by their shapes
    digest = hashlib.sha256(repr(settings).encode())
    for values in (*jax.tree.leaves(anchors), colors):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _write(path: Path, step: int, state: State, signature: str) -> None:
    leaves = {f"leaf{number}": np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves(state))}
    save_headed(path, {"signature": signature, "step": step}, leaves)


def _read(path: Path, state: State, signature: str) -> tuple[int, State]:
    """Read the step to resume from and its state; the initial ones if there is no file, or it is of another fit."""
    leaves, tree = jax.tree.flatten(state)
    try:
        header, found = load_headed(path, {"signature": signature})
    except (OSError, ValueError):
        return 0, state
    leaves = [jnp.asarray(found[f"leaf{number}"], leaf.dtype) for number, leaf in enumerate(leaves)]
    return int(header["step"]), jax.tree.unflatten(tree, leaves)


def without_transparent(anchors: Anchors, fitted: Appearance, min_opacity: float) -> tuple[Anchors, Appearance]:
    """Keep the splats whose opacity is at least `min_opacity`; ValueError if none is left."""
    opacity = np.asarray(jax.nn.sigmoid(fitted.logit))
    keep = opacity >= min_opacity
    if not keep.any():
        raise ValueError(
            f"polish.min_opacity={min_opacity:g} leaves no splat: the largest opacity is {opacity.max(initial=0):.3g}"
        )
    return jax.tree.map(lambda leaf: leaf[keep], (anchors, fitted))
