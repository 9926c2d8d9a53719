"""Moving things: points in places where other frames see free space. Free space decides, not a class."""

import math
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.observation import Observation, depth_range
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, nearest_pixel, project
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced
from emgs_jax.registration.pose_estimate import PoseEstimate


class MotionConfig(eqx.Module):
    """How to tell a moving thing from the static scene and from a wrong prediction.

    Args:
        num_looks: tracked frames before and after a frame that are compared with it; 0: nothing moves, as printed. What
            stands still for about half as many frames is mapped.
        hit: log-likelihood ratio, static to moving, of a look that shows a surface exactly where the point is.
        miss: the most that a look subtracts if it shows free space there; that look may be a wrong prediction.
        prior: log-odds of static before any look.
        radius: half side, in pixels of the thinned image, of the square over which the log-odds are averaged: wrong
            predictions lie along edges, whereas a moving thing is an area.
    """

    num_looks: int = static(low=0, high=64)
    hit: Float[Array, "*b"] = traced(2.0, low=0)
    miss: Float[Array, "*b"] = traced(4.0, low=0)
    prior: Float[Array, "*b"] = traced(4.0, low=-math.inf)
    radius: int = static(1, low=0, high=16)


class Looks(eqx.Module):
    """The last tracked frames, newest first, and what later frames have shown about their points.

    Args:
        points: of each frame, aligned, in its own camera frame (m); 0 where there is none.
        depth: nearest and farthest z (m) among a pixel and its eight neighbours; 0 where there is none.
        said: pixels that were taken for moving when the frame was mapped.
        moving: these, and pixels that later frames show to have moved; they are no evidence of a surface.
        log_odds: of static to moving, by later frames: a sum of log-likelihood ratios.
        free: the most free space that a later frame has shown behind a point, in standard deviations.
        step: the largest increase of `free` from one frame to the next.
        time: of each frame, as `SlamState.time`; -1 without a frame.
        T_previous_look: pose of each camera in that of the last frame, so that it stays valid when the map moves.
    """

    points: Float[Array, "*k p 3"]
    depth: Float[Array, "*k 2 p"]
    said: Bool[Array, "*k p"]
    moving: Bool[Array, "*k p"]
    log_odds: Float[Array, "*k p"]
    free: Float[Array, "*k p"]
    step: Float[Array, "*k p"]
    time: Int[Array, "*k"]
    T_previous_look: jaxlie.SE3


def no_looks(view: Observation, config: MotionConfig) -> Looks | None:
    """Make the looks before the first frame; None if motion is off.

    Args:
        view: any observation, for its number of rows.
    """
    if config.num_looks == 0:
        return None
    size, never = view.valid.shape[-1], jnp.asarray(-1, jnp.int32)
    nothing = _first_look(jnp.zeros((size, 3)), jnp.zeros((2, size)), jnp.zeros(size, bool), never)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (config.num_looks, *leaf.shape)), nothing)


def _first_look(
    points: Float[Array, "p 3"], depth: Float[Array, "2 p"], moving: Bool[Array, "p"], time: Int[Array, ""]
) -> Looks:
    """Make a look of the last frame, before any later frame."""
    zeros = jnp.zeros(moving.shape)
    return Looks(points, depth, moving, moving, zeros, zeros, zeros, time, jaxlie.SE3.identity())


def looks_from(looks: Looks, T_camera_previous: jaxlie.SE3) -> Looks:
    """Keep the looks in place in the world, but relative to another camera than the last one."""
    poses = jax.vmap(lambda T: (T_camera_previous @ jaxlie.SE3(T)).wxyz_xyz)(looks.T_previous_look.wxyz_xyz)
    return replace(looks, T_previous_look=jaxlie.SE3(poses))


@full_precision
def look_back(
    looks: Looks,
    view: Observation,
    moving: Bool[Array, "p"],
    T_world_camera: jaxlie.SE3,
    T_world_previous: jaxlie.SE3,
    estimate: PoseEstimate,
    camera: Camera,
    config: MotionConfig,
) -> Looks:
    """Update the looks by the evidence of one more frame, see `_evidence` and `_moves`.

    `find_movers` uses the looks before a frame, this function the frames after a look. They are separate: what stands
    for a while and then leaves has moved, however many earlier looks saw it stand.

    Args:
        view: the aligned frame, world frame.
        moving: its rows that move.
        estimate: of its pose, with the noise of its depths; noise of 0 is unknown, and gives no evidence.
    """
    looks = looks_from(looks, T_world_camera.inverse() @ T_world_previous)
    depth, evidence = jnp.nan_to_num(depth_range(view, T_world_camera, camera)), _evidence(estimate, camera, config)
    ratios, free = jax.vmap(lambda points, T: evidence(jaxlie.SE3(T) @ points, depth, moving))(
        looks.points, looks.T_previous_look.wxyz_xyz
    )
    is_told = (looks.depth[:, 0] > 0) & (estimate.depth_noise > 0)
    log_odds = looks.log_odds + jnp.where(is_told, ratios, 0.0)
    free = jnp.where(is_told, jnp.maximum(free, looks.free), looks.free)
    step = jnp.maximum(looks.step, free - looks.free)
    moves = jax.vmap(lambda *told: _moves(*told, camera, config))(looks.depth[:, 0] > 0, log_odds, step)
    return replace(looks, moving=looks.said | moves, log_odds=log_odds, free=free, step=step)


@full_precision
def look_again(
    looks: Looks,
    view: Observation,
    moving: Bool[Array, "p"],
    T_world_camera: jaxlie.SE3,
    time: Int[Array, ""],
    camera: Camera,
) -> Looks:
    """Add a frame with a valid point as the newest look, and make all looks relative to this camera.

    Args:
        view: the aligned frame, world frame.
        moving: its rows that move.
    """
    points = jnp.where(view.valid[:, None], T_world_camera.inverse() @ view.points, 0.0)
    newest = _first_look(points, jnp.nan_to_num(depth_range(view, T_world_camera, camera)), moving, time)
    is_look = jnp.any(view.valid)
    return jax.tree.map(lambda new, old: jnp.where(is_look, jnp.concatenate([new[None], old[:-1]]), old), newest, looks)


@full_precision
def find_movers(
    looks: Looks,
    view: Observation,
    T_previous_camera: jaxlie.SE3,
    estimate: PoseEstimate,
    camera: Camera,
    config: MotionConfig,
) -> Bool[Array, "p"]:
    """Find the valid points of a frame that move, by the looks before it, see `_evidence` and `_moves`.

    A point that no look saw is static.

    Args:
        view: camera frame, in the map's unit.
        T_previous_camera: from this camera to that of the last frame.
        estimate: of this pose, with the noise ν of depths; noise of 0 is unknown, and nothing moves.
    """
    evidence = _evidence(estimate, camera, config)

    def ask(look: Looks) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
        return evidence((look.T_previous_look.inverse() @ T_previous_camera) @ view.points, look.depth, look.moving)

    ratios, free = jax.vmap(ask)(looks)
    step = jnp.max(jnp.diff(jax.lax.cummax(free), axis=0, prepend=0.0), axis=0)
    is_told = view.valid & (estimate.depth_noise > 0)
    return _moves(is_told, jnp.sum(ratios, axis=0), step, camera, config)


def _evidence(estimate: PoseEstimate, camera: Camera, config: MotionConfig) -> Callable:
    """Make the evidence of a look on points in its camera frame: log-likelihood ratio, static to moving; free space.

    A point of depth z is compared with the depths d around its pixel in the look. With g the distance to them in
    standard deviations, the ratio is hit - g²/2. In front of them, in free space, it is at least -miss, because either
    prediction may be wrong. Behind them the point is occluded, and the ratio is at least 0. The variance of z - d is
    that of both depths, 2 (ν z)², plus that of the pose at that distance.

    Args:
        estimate: of the newer one of both poses.

    Returns:
        A function of points (p, 3), the look's range of depths (2, p) and its moving pixels. It gives the ratios and
        the free space behind each point in standard deviations; 0 where the look shows nothing.
    """
    pose_variance = jnp.diagonal(estimate.covariance)
    shift, turn = jnp.mean(pose_variance[:3]), jnp.mean(pose_variance[3:6])

    def evidence(
        points: Float[Array, "p 3"], depth: Float[Array, "2 p"], moving: Bool[Array, "p"]
    ) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
        pixels, z = project(camera, points)
        index, inside = nearest_pixel(pixels, (camera.height, camera.width))
        nearest, farthest = depth[:, index]
        std = jnp.sqrt(2.0 * (estimate.depth_noise * z) ** 2 + shift + turn * z**2)
        std = jnp.maximum(std, NEAREST_DEPTH)
        before, behind = (jnp.maximum(gap, 0.0) / std for gap in (nearest - z, z - farthest))
        ratio = jnp.maximum(config.hit - 0.5 * (before + behind) ** 2, jnp.where(before > 0, -config.miss, 0.0))
        ratio = jnp.where(moving[index], jnp.minimum(ratio, 0.0), ratio)
        is_seen = inside & (z > NEAREST_DEPTH) & (nearest > 0)
        return jnp.where(is_seen, ratio, 0.0), jnp.where(is_seen, before, 0.0)

    return evidence


def _moves(
    is_told: Bool[Array, "p"],
    log_odds: Float[Array, "p"],
    step: Float[Array, "p"],
    camera: Camera,
    config: MotionConfig,
) -> Bool[Array, "p"]:
    """Decide which pixels of a frame move, by the looks' summed evidence, averaged over neighbours.

    Depths of a network drift: a static surface comes nearer by some percent a frame, until all older looks see through
    it. A moving thing opens free space from one look to the next. Let j be the largest increase, in standard
    deviations, of the free space behind a point from one look to the next one farther in time. The log-odds of static
    are at least prior + hit - j²/2.
    """
    drifting = config.hit - 0.5 * step**2
    found = jnp.where(is_told, config.prior + jnp.maximum(log_odds, drifting), 0.0)
    most = config.miss * config.num_looks
    return is_told & (_box_sum(jnp.clip(found, -most, most), camera, config.radius) < 0)


def _box_sum(values: Float[Array, "p"], camera: Camera, radius: int) -> Float[Array, "p"]:
    window = (2 * radius + 1,) * 2
    image = values.reshape(camera.height, camera.width)
    return jax.lax.reduce_window(image, 0.0, jax.lax.add, window, (1, 1), "SAME").reshape(-1)
