"""The pipeline: `init_state` makes the map of the first window, `step` integrates one frame. Both are pure."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.em import EmConfig, EmInfo, em_update, owners
from emgs_jax.existence import (
    ExistenceConfig,
    Look,
    Seen,
    fusion_evidence,
    merge_duplicates,
    take_back,
    update_existence,
)
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
from emgs_jax.gaussians import FitConfig, GaussianIndex, Gaussians, cluster, index_of, spacing
from emgs_jax.initialization import initialize
from emgs_jax.localization import CoarsePose, LocalizationConfig, LocalizationInfo, localize_coarse, localize_fine
from emgs_jax.motion import Looks, MotionConfig, find_movers, look_again, look_back, no_looks
from emgs_jax.observation import (
    Observation,
    ObservationConfig,
    Prediction,
    sound,
    sound_covariances,
    sound_poses,
    transform,
)
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.executable import executable
from emgs_jax.ops.neighbours import group_points, order_of
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, static_choice, take_rows
from emgs_jax.refinement import RefinementConfig, RefinementInfo, refine, without_scattered
from emgs_jax.registration.depth_field import moved_by_field
from emgs_jax.registration.pose_estimate import PoseEstimate, exact_estimate
from emgs_jax.registration.rigid import median, pose_row
from emgs_jax.splitting import SplittingConfig, split
from emgs_jax.surface_extrapolation import ExtrapolationConfig, extrapolate

Stage = Callable[..., Any]


class Stages(NamedTuple):
    """The stages of a step, each of which can be replaced: `map_sequence(config, em_update=mine)`.

    A replacement takes and returns what the original does. A program is compiled for each set of functions.
    """

    initialize: Stage = initialize
    localize_coarse: Stage = localize_coarse
    select_submap: Stage = select_submap
    find_movers: Stage = find_movers
    localize_fine: Stage = localize_fine
    em_update: Stage = em_update
    split: Stage = split
    extrapolate: Stage = extrapolate
    refine: Stage = refine
    update_existence: Stage = update_existence
    merge_duplicates: Stage = merge_duplicates


class SlamConfig(eqx.Module):
    """Configs of all stages.

    Args:
        window_size: |S|, images in the FIFO that the prior sees before the current one.
        initialization: `merged` (printed) clusters all views of the first window together; `incremental` clusters the
            first view and integrates the others one by one.
        extrapolation: of depth errors to points that no Gaussian explains.
        splitting: of Gaussians that are too coarse for a nearer view.
        existence: evidence of later frames for and against a Gaussian.
        motion: which points are taken for moving; these are neither aligned nor mapped.
        stages: the functions themselves.
    """

    window_size: int = static(low=1, high=1000)
    initialization: str = static_choice("merged", "incremental")
    observation: ObservationConfig
    fit: FitConfig
    submap: SubmapConfig
    localization: LocalizationConfig
    em: EmConfig
    extrapolation: ExtrapolationConfig
    splitting: SplittingConfig
    refinement: RefinementConfig
    existence: ExistenceConfig
    motion: MotionConfig
    stages: Stages = eqx.field(static=True, default=Stages())

    def in_unit(self, metre: float) -> "SlamConfig":
        """Return the config with its lengths in a unit in which one of their metres is `metre` long."""

        def lengths(config: "SlamConfig") -> tuple:
            stds = (stage.min_std for stage in (config.fit, config.em, config.splitting))
            return *stds, config.submap.voxel_size, config.submap.margin

        return self if metre == 1 else eqx.tree_at(lengths, self, replace_fn=lambda length: metre * length)

    @property
    def fusion(self) -> "FusionConfig":
        """Settings of the fusion only, so that changing others does not compile it again."""
        return FusionConfig(self.em, self.extrapolation, self.splitting, self.stages)


class FusionConfig(eqx.Module):
    """Settings of the fusion of a frame's points, see `SlamConfig`."""

    em: EmConfig
    extrapolation: ExtrapolationConfig
    splitting: SplittingConfig
    stages: Stages = eqx.field(static=True)


class SlamState(eqx.Module):
    """State between two steps.

    Args:
        previous: the last frame, aligned, world frame.
        estimate: uncertainty of its pose and scale.
        time: number of frames so far, lost ones included.
        looks: of earlier frames; None if motion is off.
    """

    map: GaussianMap
    previous: Observation
    T_world_previous: jaxlie.SE3
    estimate: PoseEstimate
    time: Int[Array, ""]
    looks: Looks | None = None


class Overflow(eqx.Module):
    """Rows that did not fit. If either of the first two is not 0, repeat the step with more capacity."""

    map: Int[Array, ""]
    submap: Int[Array, ""]
    tiles: Int[Array, ""]


class StepInfo(eqx.Module):
    """Diagnostics of one step.

    Args:
        origin: median birth of the Gaussians that explain the frame's points; its own time if none do.
        num_left_out: points of the frame that are beyond any map or not finite.
        moving: pixels of the thinned image that are taken for moving.
        seen: the frame that has just left the looks, with all that is known of what moved in it.
    """

    T_world_camera: jaxlie.SE3
    T_world_newest: jaxlie.SE3
    localization: LocalizationInfo
    em: EmInfo
    refinement: RefinementInfo
    origin: Int[Array, ""]
    num_gaussians: Int[Array, ""]
    num_left_out: Int[Array, ""]
    moving: Bool[Array, "h w"]
    overflow: Overflow
    seen: Seen | None = None


class Submap(eqx.Module):
    """M*, the part of the map that a step works on, with an index for all stages.

    Args:
        rows: of the whole map; its capacity for empty rows.
    """

    map: GaussianMap
    rows: Int[Array, "s"]
    index: GaussianIndex
    overflow: Int[Array, ""]


class Frame(eqx.Module):
    """A frame at its fine pose.

    Args:
        points: its observation, world frame.
        moving: rows that are taken for moving.
    """

    T_world_camera: jaxlie.SE3
    points: Observation
    localization: LocalizationInfo
    time: Int[Array, ""]
    moving: Bool[Array, "p"]

    @property
    def seen(self) -> Observation:
        """Its points; none is valid if the frame is not tracked."""
        points = self.points
        return eqx.tree_at(lambda o: o.valid, points, points.valid & self.localization.is_tracked)

    @property
    def trusted(self) -> Observation:
        """The points of `seen` that are not taken for moving."""
        return _without(self.seen, self.moving)


class Fused(eqx.Module):
    """Submap after a frame's points are fused into it.

    Args:
        unexplained: points that no Gaussian explains, corrected by depth errors extrapolated from the map's surfaces.
        origin: median birth of the Gaussians that explain the others; the frame's own time if none do.
    """

    map: GaussianMap
    halves: GaussianMap
    unexplained: Observation
    origin: Int[Array, ""]
    em: EmInfo


class NewGaussians(eqx.Module):
    """Gaussians that a frame adds to the map: new ones with their number of images, and halves of split ones."""

    gaussians: Gaussians
    weight: Float[Array, "g"]
    halves: GaussianMap


def _without(points: Observation, moving: Bool[Array, "p"]) -> Observation:
    return eqx.tree_at(lambda o: o.valid, points, points.valid & ~moving)


def _first_weight(weight: Float[Array, "g"], config: AverageConfig) -> Float[Array, "g"]:
    """Give a new Gaussian its weight: α_0 = 1 as printed, or the number of images that its points amount to."""
    return jnp.where(config.gain > 0, weight, 1.0)


@full_precision
def init_state(
    views: Observation, T_world_views: jaxlie.SE3, camera: Camera, config: SlamConfig
) -> tuple[SlamState, Int[Array, ""]]:
    """Make the state after the first window: its map, with the last view as the previous frame.

    Args:
        views: the window's observations, camera frames, oldest first.
        camera: of the full images.

    Returns:
        The state, and how many Gaussians did not fit into the map.
    """
    gaussians, weight, world = config.stages.initialize(
        views, T_world_views, camera, config.observation.thin, config.fit
    )
    view = downscale(camera, config.observation.thin)
    return _first_state(gaussians, weight, world, T_world_views, view, config)


@executable
def _first_state(
    gaussians: Gaussians,
    weight: Float[Array, "g"],
    world: Observation,
    T_world_views: jaxlie.SE3,
    view: Camera,
    config: SlamConfig,
) -> tuple[SlamState, Int[Array, ""]]:
    pose = pose_row(sound_poses(T_world_views), -1)
    gaussians = without_scattered(gaussians, pose, view, config.fit.min_std, config.refinement)
    # The second frame has nothing else to align with, so the first window confirms itself.
    existence = jnp.maximum(config.existence.birth, config.existence.hit)
    time = jnp.asarray(world.valid.shape[0], jnp.int32)
    new = new_map(gaussians, _first_weight(weight, config.em.average), existence, time - 1)
    map, _, overflow = insert(empty_map(config.submap.map_capacity, world.features.shape[-1]), new)
    last, looks = jax.tree.map(lambda leaf: leaf[-1], world), None
    if (before := no_looks(last, config.motion)) is not None:
        still = jnp.zeros(last.valid.shape, bool)
        looks = look_again(before, last, still, pose, time - 1, view)
    state = SlamState(map, last, pose, exact_estimate(), time, looks)
    return state, overflow


@full_precision
def step(state: SlamState, prediction: Prediction, camera: Camera, config: SlamConfig) -> tuple[SlamState, StepInfo]:
    """Integrate one frame: localize, select, E-step, M-step, refine, insert (the paper's pipeline figure).

    Called directly, each stage is its own executable, so a larger map recompiles selection and insertion but not the
    work on the submap. Inside another jit or vmap everything is one program, which rounds differently.

    Args:
        camera: of the full images.
    """
    view = downscale(camera, config.observation.thin)  # its pixels are an observation's rows
    num_rows, stages = spacing(camera, config.observation.thin, config.fit), config.stages

    coarse, current, guess, num_left_out = _localize_coarse(
        prediction, state.previous, state.T_world_previous, state.estimate, view, config.localization, stages
    )
    submap = _select(state.map, state.previous, guess, config.submap, stages)
    moving = _find_movers(state.looks, current, state.T_world_previous, coarse, view, config.motion, stages)
    frame = _localize_fine(current, moving, submap, coarse, state.time, config.localization, stages)
    fused = _fuse(submap, frame, view, num_rows, config.fusion)
    candidates, weight = cluster(fused.unexplained, _order(view), num_rows, config.fit)
    refined, fresh, refinement = _refine(fused.map, candidates, frame.T_world_camera, view, config)
    new = NewGaussians(fresh, weight, fused.halves)
    looks, seen = None, None
    if state.looks is not None:
        looks, seen = _look(state.looks, frame, state.T_world_previous, view, config.motion)
    map, num_gaussians, overflow, time = _store(
        state.map, replace(submap, map=refined), new, frame, seen, state.T_world_previous, view, config
    )

    info = StepInfo(
        T_world_camera=frame.T_world_camera,
        T_world_newest=coarse.T_world_newest,
        localization=frame.localization,
        em=fused.em,
        refinement=refinement,
        origin=fused.origin,
        num_gaussians=num_gaussians,
        num_left_out=num_left_out,
        moving=moving.reshape(view.height, view.width),
        overflow=Overflow(overflow, submap.overflow, refinement.overflow),
        seen=seen,
    )
    return SlamState(map, frame.points, frame.T_world_camera, frame.localization.estimate, time, looks), info


@executable
def _localize_coarse(
    prediction: Prediction,
    previous: Observation,
    T_world_previous: jaxlie.SE3,
    estimate: PoseEstimate,
    view: Camera,
    config: LocalizationConfig,
    stages: Stages,
) -> tuple[CoarsePose, Observation, Observation, Int[Array, ""]]:
    """Compute the coarse pose, the frame without unusable points, the same at that pose, and how many were left out."""
    current, before = sound(prediction.current), sound(prediction.previous)
    num_left_out = jnp.sum(prediction.current.valid & ~current.valid)
    prediction = replace(
        prediction,
        current=current,
        previous=before,
        T_world_views=sound_poses(prediction.T_world_views),
        T_world_anchor=sound_poses(prediction.T_world_anchor),
        pose_covariance=sound_covariances(prediction.pose_covariance),
    )
    coarse = stages.localize_coarse(prediction, previous, T_world_previous, view, config, estimate)
    return coarse, current, transform(coarse.T_world_camera, current, coarse.scale), num_left_out


@executable
def _select(
    map: GaussianMap, previous: Observation, guess: Observation, config: SubmapConfig, stages: Stages
) -> Submap:
    submap, rows, overflow = stages.select_submap(map, (previous, guess), config)
    return Submap(submap, rows, index_of(submap.gaussians), overflow)


@executable
def _find_movers(
    looks: Looks | None,
    current: Observation,
    T_world_previous: jaxlie.SE3,
    coarse: CoarsePose,
    view: Camera,
    config: MotionConfig,
    stages: Stages,
) -> Bool[Array, "p"]:
    """Find what moves in a frame at its coarse pose."""
    if looks is None:
        return jnp.zeros(current.valid.shape, bool)
    points = transform(jaxlie.SE3.identity(), current, coarse.scale)
    T_previous_camera = T_world_previous.inverse() @ coarse.T_world_camera
    return stages.find_movers(looks, points, T_previous_camera, coarse.estimate, view, config)


@executable
def _look(
    looks: Looks, frame: Frame, T_world_previous: jaxlie.SE3, view: Camera, config: MotionConfig
) -> tuple[Looks, Seen]:
    """Update the looks by a frame; return them and the oldest one, which leaves them, with the evidence about it."""
    estimate, T = frame.localization.estimate, frame.T_world_camera
    told = look_back(looks, frame.seen, frame.moving, T, T_world_previous, estimate, view, config)
    after, is_over = look_again(told, frame.seen, frame.moving, T, frame.time, view), jnp.any(frame.seen.valid)
    oldest = as_seen(jax.tree.map(lambda leaf: leaf[-1], told), T, estimate.depth_noise)
    return after, oldest._replace(moves=oldest.moves & is_over, time=jnp.where(is_over, oldest.time, -1))


@full_precision
def as_seen(look: Looks, T_world_last: jaxlie.SE3, depth_noise: Float[Array, ""]) -> Seen:
    """Summarise a look by what later frames found to move in it; `depth_noise` is that of the last frame."""
    moves = look.moving & ~look.said
    return Seen(look.depth, moves, T_world_last @ look.T_previous_look, depth_noise, look.time)


@executable
def _localize_fine(
    current: Observation,
    moving: Bool[Array, "p"],
    submap: Submap,
    coarse: CoarsePose,
    time: Int[Array, ""],
    config: LocalizationConfig,
    stages: Stages,
) -> Frame:
    """Register the frame to the confirmed Gaussians."""
    target = confirmed(submap.map)
    groups = group_points(target.means, target.valid, order_of(submap.index.groups, target.valid.shape[0]))
    index = GaussianIndex(submap.index.white, groups)
    T, aligned, localization = stages.localize_fine(_without(current, moving), target, coarse, config, index)
    points = eqx.tree_at(lambda o: o.valid, aligned, aligned.valid | moving & coarse.is_usable)
    return Frame(T, points, localization, time, moving)


@executable
def _fuse(submap: Submap, frame: Frame, view: Camera, num_rows: int, config: FusionConfig) -> Fused:
    """Fuse the points of a tracked frame, and split Gaussians that they show to be too coarse."""
    T, trusted = frame.T_world_camera, frame.trusted
    noise = frame.localization.noise[:, None] * (trusted.points - T.translation())
    map, explained, info = config.stages.em_update(submap.map, trusted, noise, config.em, submap.index)
    owned = owners(explained, map.birth.shape[0])
    births = take_rows(map.birth, owned).astype(jnp.float32)
    origin = jnp.where(info.num_fused > 0, median(births, explained.is_fused), frame.time).astype(jnp.int32)
    map, halves = config.stages.split(map, trusted, noise, owned, num_rows, config.splitting)
    explained_by, noise = take_rows(submap.map, owned), frame.localization.noise
    moved = config.stages.extrapolate(trusted, explained_by, explained.is_fused, noise, T, view, config.extrapolation)
    unexplained = eqx.tree_at(lambda o: o.valid, moved, trusted.valid & ~explained.is_fused)
    # The frame was moved onto the map, the mean of W frames: 1 / (W + 1) of their difference is the map's own error.
    weight = median(explained_by.weight, explained.is_fused)
    share = jnp.where(info.num_fused > 0, 1.0 / (weight + 1.0), 0.0)
    # The whole image moves uniformly, fused or not, so that no surface tears.
    places = lambda s: (s[0].gaussians.means, s[1].gaussians.means, s[2].points)  # noqa: E731
    surface = map, halves, unexplained
    means = [moved_by_field(points, frame.localization.icp.field, share, T) for points in places(surface)]
    map, halves, unexplained = eqx.tree_at(places, surface, tuple(means))
    return Fused(map, halves, unexplained, origin, info)


@executable
def _order(view: Camera) -> Int[Array, "p"]:
    return morton_order(view.height, view.width)


@executable
def _refine(
    map: GaussianMap,
    candidates: Gaussians,
    T_world_camera: jaxlie.SE3,
    view: Camera,
    config: SlamConfig,
) -> tuple[GaussianMap, Gaussians, RefinementInfo]:
    surfaces = without_scattered(candidates, T_world_camera, view, config.fit.min_std, config.refinement)
    return config.stages.refine(map, surfaces, T_world_camera, view, config.refinement)


@executable
def _store(
    map: GaussianMap,
    submap: Submap,
    new: NewGaussians,
    frame: Frame,
    seen: Seen | None,
    T_world_previous: jaxlie.SE3,
    view: Camera,
    config: SlamConfig,
) -> tuple[GaussianMap, Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """Write the submap back, update existence, merge duplicates, and insert new Gaussians and halves into free rows.

    Returns:
        The map, the number of its Gaussians, how many did not fit, and the time of the next frame.
    """
    rows, T, noise = submap.rows, frame.T_world_camera, frame.localization.depth_noise
    evidence, map = fusion_evidence(map, submap.map, rows), write_back(map, submap.map, rows)
    look = Look(frame.seen, T, view, noise, T_world_previous)
    map, is_seen = config.stages.update_existence(map, evidence, look, config.existence)
    if seen is not None:
        map = take_back(map, seen, view, config.existence)
    is_seen = jnp.take(is_seen, rows, mode="fill", fill_value=False)
    merged = config.stages.merge_duplicates(take_rows(map, rows), is_seen, T.translation(), noise, config.existence)
    born = new_map(new.gaussians, _first_weight(new.weight, config.em.average), config.existence.birth, frame.time)
    born = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), born, new.halves)
    map, _, overflow = insert(write_back(map, merged, rows), born)
    return map, jnp.sum(map.gaussians.valid), overflow, frame.time + 1
