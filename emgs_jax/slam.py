"""The pipeline: `init_state` makes the map of the first window, `step` integrates one frame. Both are pure."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from emgs_jax.continuation import ContinuationConfig, continued
from emgs_jax.em import EmConfig, EmInfo, em_update, owners
from emgs_jax.existence import ExistenceConfig, join_layers, judge, usefulness
from emgs_jax.gaussian_map import (
    AverageConfig,
    GaussianMap,
    SubmapConfig,
    confirmed,
    empty_map,
    insert,
    new_map,
    select_submap,
    write_back,
)
from emgs_jax.gaussians import FitConfig, Gaussians, cluster, spacing
from emgs_jax.initialization import initialize
from emgs_jax.localization import CoarsePose, LocalizationConfig, LocalizationInfo, localize_coarse, localize_fine
from emgs_jax.observation import Observation, ObservationConfig, Prediction, transform
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.linalg import Whitening, whitening
from emgs_jax.ops.neighbours import Groups, group_points, order_of
from emgs_jax.ops.precision import directly, full_precision
from emgs_jax.ops.pytree import static, static_choice, take_rows
from emgs_jax.refinement import RefinementConfig, RefinementInfo, refine
from emgs_jax.registration.belief import Belief, certain
from emgs_jax.registration.rigid import median, pose_row
from emgs_jax.splitting import SplittingConfig, split

Index: TypeAlias = tuple[Whitening, Groups]  # of the submap's Gaussians


class SlamConfig(eqx.Module):
    """All stages.

    Args:
        window_size: |S|, images in the FIFO that the prior sees before the current one.
        initialization: `merged` (printed): all views of the first window are clustered together; `incremental`: the
            first view is, and the others are integrated one by one.
        observation: point maps to observations.
        fit: points to Gaussians (eq. 1).
        submap: what a step works on, and capacities.
        localization: coarse and fine.
        em: E- and M-step.
        continuation: where points that no Gaussian explains go on from the map.
        splitting: of Gaussians that are too coarse for a nearer view.
        refinement: on the image plane.
        existence: what later frames say of a Gaussian.
    """

    window_size: int = static(low=1, high=1000)
    initialization: str = static_choice("merged", "incremental")
    observation: ObservationConfig
    fit: FitConfig
    submap: SubmapConfig
    localization: LocalizationConfig
    em: EmConfig
    continuation: ContinuationConfig
    splitting: SplittingConfig
    refinement: RefinementConfig
    existence: ExistenceConfig


class SlamState(eqx.Module):
    """What the next step needs.

    Args:
        map: all Gaussians.
        previous: the last frame as it was aligned, world frame.
        T_world_previous: its pose.
        belief: how well that is known.
        time: frames so far, those that could not be placed included.
    """

    map: GaussianMap
    previous: Observation
    T_world_previous: jaxlie.SE3
    belief: Belief
    time: Int[Array, ""]


class Overflow(eqx.Module):
    """How many rows did not fit: a step with any of the first two is to be repeated with more room."""

    map: Int[Array, ""]
    submap: Int[Array, ""]
    tiles: Int[Array, ""]


class StepInfo(eqx.Module):
    """What one step did; `origin` is the median birth of the Gaussians that explain its points, its own if none do."""

    T_world_camera: jaxlie.SE3
    T_world_newest: jaxlie.SE3
    localization: LocalizationInfo
    em: EmInfo
    refinement: RefinementInfo
    origin: Int[Array, ""]
    num_gaussians: Int[Array, ""]
    overflow: Overflow


def _first_weight(weight: Float[Array, "g"], config: AverageConfig) -> Float[Array, "g"]:
    """Weight of a new Gaussian: α_0 = 1 as printed, or the number of images that its points amount to."""
    return jnp.where(config.gain > 0, weight, 1.0)


@full_precision
def init_state(
    views: Observation, T_world_views: jaxlie.SE3, camera: Camera, config: SlamConfig, call: Callable = directly
) -> tuple[SlamState, Int[Array, ""]]:
    """The map of the first window, whose last view becomes the previous frame.

    Args:
        views: the window's observations, camera frames, oldest first.
        T_world_views: their poses.
        camera: of the full images.
        call: how an executable is called.

    Returns:
        The state, and how many Gaussians did not fit into the map's capacity.
    """
    thin = config.observation.thin
    gaussians, weight, world = initialize(views, T_world_views, camera, thin, config.fit, call)
    return call(_first_state, gaussians, weight, world, T_world_views, config)


@eqx.filter_jit
def _first_state(
    gaussians: Gaussians, weight: Float[Array, "g"], world: Observation, T_world_views: jaxlie.SE3, config: SlamConfig
) -> tuple[SlamState, Int[Array, ""]]:
    # There is nothing else to align the second frame with, so the first window confirms itself.
    existence = jnp.maximum(config.existence.birth, config.existence.hit)
    time = jnp.asarray(world.valid.shape[0], jnp.int32)
    new = new_map(gaussians, _first_weight(weight, config.em.average), existence, time - 1)
    map, _, overflow = insert(empty_map(config.submap.map_capacity, world.features.shape[-1]), new)
    state = SlamState(map, jax.tree.map(lambda leaf: leaf[-1], world), pose_row(T_world_views, -1), certain(), time)
    return state, overflow


@full_precision
def step(
    state: SlamState,
    prediction: Prediction,
    camera: Camera,
    config: SlamConfig,
    call: Callable = directly,
) -> tuple[SlamState, StepInfo]:
    """Integrate one frame: localise, select, E-step, M-step, refine, insert (the paper's pipeline figure).

    Called as it is, each line is an executable of its own, so that a larger map compiles the look-up and the insertion
    anew and not the work on the submap; inside another jit or vmap all of it is one, which rounds differently.

    Args:
        state: of the last step.
        prediction: of this one.
        camera: of the full images.
        config: all stages.
        call: how an executable is called; `running.growth.prepare` learns from it what there is to compile.
    """
    thin, last = config.observation.thin, (state.previous, state.T_world_previous, state.belief)
    coarse, guess = call(_approach, prediction, last, camera, thin, config.localization)
    submap, index, rows, submap_overflow = call(_select, state.map, (state.previous, guess), config.submap)
    T, aligned, localization = call(_place, prediction.current, submap, coarse, config.localization, index)
    rows_each, place = spacing(camera, thin, config.fit), (aligned, T, localization)
    fine = rows_each, downscale(camera, thin), config.em, config.continuation, config.splitting
    submap, rest, em, halves, origin = call(_fuse, submap, index, *place, state.time, *fine)
    candidates, weight = call(cluster, rest, call(_order, camera, thin), rows_each, config.fit)
    submap, fresh, refinement = call(_refine, submap, candidates, T, camera, thin, config.refinement)
    look = (fresh, weight, halves), place, state.time
    map, count, map_overflow, time = call(_store, state.map, submap, rows, *look, camera, config)

    info = StepInfo(
        T_world_camera=T,
        T_world_newest=coarse.T_world_newest,
        localization=localization,
        em=em,
        refinement=refinement,
        origin=origin,
        num_gaussians=count,
        overflow=Overflow(map_overflow, submap_overflow, refinement.overflow),
    )
    return SlamState(map, aligned, T, localization.belief, time), info


@eqx.filter_jit
def _approach(
    prediction: Prediction,
    last: tuple[Observation, jaxlie.SE3, Belief],
    camera: Camera,
    thin: int,
    config: LocalizationConfig,
) -> tuple[CoarsePose, Observation]:
    """The coarse pose, and the current frame placed by it."""
    coarse = localize_coarse(prediction, *last[:2], downscale(camera, thin), config, last[2])
    return coarse, transform(coarse.T_world_camera, prediction.current, coarse.scale)


@eqx.filter_jit
def _select(
    map: GaussianMap, clouds: tuple[Observation, ...], config: SubmapConfig
) -> tuple[GaussianMap, Index, Int[Array, "s"], Int[Array, ""]]:
    """`select_submap` with what is found once for all stages until EM, while its Gaussians stay as they are."""
    submap, rows, overflow = select_submap(map, clouds, config)
    gaussians = submap.gaussians
    index = whitening(gaussians.covs), group_points(gaussians.means, gaussians.valid)
    return submap, index, rows, overflow


@eqx.filter_jit
def _place(
    current: Observation, submap: GaussianMap, coarse: CoarsePose, config: LocalizationConfig, index: Index
) -> tuple[jaxlie.SE3, Observation, LocalizationInfo]:
    """The fine pose, against what is confirmed."""
    white, groups = index
    target = confirmed(submap)
    of_confirmed = group_points(target.means, target.valid, order_of(groups, target.valid.shape[0]))
    return localize_fine(current, target, coarse, config, white, of_confirmed)


@eqx.filter_jit
def _fuse(
    submap: GaussianMap,
    index: Index,
    aligned: Observation,
    T: jaxlie.SE3,
    localization: LocalizationInfo,
    time: Int[Array, ""],
    spacing: int,
    view: Camera,
    config: EmConfig,
    continuation: ContinuationConfig,
    splitting: SplittingConfig,
) -> tuple[GaussianMap, Observation, EmInfo, GaussianMap, Int[Array, ""]]:
    """Fuse the points of a frame that is tracked, and split what they show to be too coarse.

    Returns the submap, the points that no Gaussian explains (they go on from the map), counts, the second halves of
    what was split, and the median birth of what explains the others.
    """
    trusted = _trusted(aligned, localization)
    noise = localization.noise[:, None] * (trusted.points - T.translation())
    before = submap
    submap, explained, em = em_update(submap, trusted, noise, config, *index)
    owned = owners(explained, submap.birth.shape[0])
    births = take_rows(submap.birth, owned).astype(jnp.float32)
    origin = jnp.where(em.num_fused > 0, median(births, explained.is_fused), time).astype(jnp.int32)
    submap, halves = split(submap, trusted, noise, owned, spacing, splitting)
    explained_by, spread = take_rows(before, owned), (localization.noise, T, view)
    rest = continued(trusted, explained_by, explained.is_fused, *spread, continuation)
    rest = eqx.tree_at(lambda o: o.valid, rest, trusted.valid & ~explained.is_fused)
    return submap, rest, em, halves, origin


def _trusted(aligned: Observation, localization: LocalizationInfo) -> Observation:
    """The frame without a valid row where it is not tracked."""
    return eqx.tree_at(lambda o: o.valid, aligned, aligned.valid & localization.is_tracked)


@eqx.filter_jit
def _order(camera: Camera, thin: int) -> Int[Array, "p"]:
    view = downscale(camera, thin)
    return morton_order(view.height, view.width)


@eqx.filter_jit
def _refine(
    submap: GaussianMap, candidates: Gaussians, T: jaxlie.SE3, camera: Camera, thin: int, config: RefinementConfig
) -> tuple[GaussianMap, Gaussians, RefinementInfo]:
    return refine(submap, candidates, T, downscale(camera, thin), config)


@eqx.filter_jit
def _store(
    map: GaussianMap,
    submap: GaussianMap,
    rows: Int[Array, "s"],
    new: tuple[Gaussians, Float[Array, "g"], GaussianMap],
    place: tuple[Observation, jaxlie.SE3, LocalizationInfo],
    time: Int[Array, ""],
    camera: Camera,
    config: SlamConfig,
) -> tuple[GaussianMap, Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """The map with the submap written back, judged by this look; fresh Gaussians and second halves in free rows.

    Returns:
        The map, the number of its Gaussians, how many did not fit, and the time of the next frame.
    """
    (aligned, T, localization), (fresh, weight, halves) = place, new
    thinned, noise = downscale(camera, config.observation.thin), localization.depth_noise
    trusted = _trusted(aligned, localization)
    use = usefulness(map, submap, rows)
    map, is_seen = judge(write_back(map, submap, rows), use, trusted, T, thinned, noise, config.existence)
    is_seen = jnp.take(is_seen, rows, mode="fill", fill_value=False)
    submap = join_layers(take_rows(map, rows), is_seen, T.translation(), noise, config.existence)
    born = new_map(fresh, _first_weight(weight, config.em.average), config.existence.birth, time)
    born = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), born, halves)
    map, _, overflow = insert(write_back(map, submap, rows), born)
    return map, jnp.sum(map.gaussians.valid), overflow, time + 1
