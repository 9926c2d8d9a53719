"""Moving things: points that stand where earlier frames looked through. Free space decides, not a class."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.observation import Observation, depth_range
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, nearest_pixel, project
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced
from emgs_jax.registration.pose_estimate import PoseEstimate


class MotionConfig(eqx.Module):
    """What tells a moving thing from the static scene and from a wrong prediction.

    Args:
        num_looks: tracked frames before the current one that are compared with it; 0: nothing is taken for moving, as
            printed. What stands still for about half as many becomes map.
        hit: log-likelihood ratio, static to moving, of a look that shows a surface exactly where the point is.
        miss: the most that a look which shows free space there takes away: it may be a wrong prediction.
        prior: log-odds of static before any look.
        radius: neighbours, in pixels of the thinned image, over whose square the log-odds are averaged: a prediction is
            wrong along edges, a thing that moves is an area.
    """

    num_looks: int = static(low=0, high=64)
    hit: Float[Array, "*b"] = traced(low=0)
    miss: Float[Array, "*b"] = traced(low=0)
    prior: Float[Array, "*b"] = traced(low=-math.inf)
    radius: int = static(low=0, high=16)


class Looks(eqx.Module):
    """Free space of the last tracked frames, newest first.

    Args:
        depth: of each, nearest and farthest z (m) among a pixel and its eight neighbours; 0 where it has none.
        moving: pixels that were taken for moving: they are no evidence that something stands there.
        T_previous_look: of each camera, in that of the last frame: however the map moves, they stay as they are.
    """

    depth: Float[Array, "k 2 p"]
    moving: Bool[Array, "k p"]
    T_previous_look: jaxlie.SE3


def no_looks(view: Observation, config: MotionConfig) -> Looks | None:
    """Before the first frame; None where nothing is taken for moving.

    Args:
        view: any, for its number of rows.
    """
    if config.num_looks == 0:
        return None
    size, poses = view.valid.shape[-1], jnp.tile(jaxlie.SE3.identity().wxyz_xyz, (config.num_looks, 1))
    depth, moving = jnp.zeros((config.num_looks, 2, size)), jnp.zeros((config.num_looks, size), bool)
    return Looks(depth, moving, jaxlie.SE3(poses))


@full_precision
def look_again(
    looks: Looks,
    view: Observation,
    moving: Bool[Array, "p"],
    T_world_camera: jaxlie.SE3,
    T_world_previous: jaxlie.SE3,
    camera: Camera,
) -> Looks:
    """The looks after one more frame, which is one of them if it has a valid point.

    Args:
        view: the frame as it was aligned, world frame.
        moving: its rows that move.
    """
    T_camera_previous = T_world_camera.inverse() @ T_world_previous
    old = jax.vmap(lambda look: (T_camera_previous @ jaxlie.SE3(look)).wxyz_xyz)(looks.T_previous_look.wxyz_xyz)
    poses = jnp.concatenate([jaxlie.SE3.identity().wxyz_xyz[None], old[:-1]])
    newest = jnp.nan_to_num(depth_range(view, T_world_camera, camera))
    depth = jnp.concatenate([newest[None], looks.depth[:-1]])
    marked = jnp.concatenate([moving[None], looks.moving[:-1]])
    is_look = jnp.any(view.valid)
    depth, marked = jnp.where(is_look, depth, looks.depth), jnp.where(is_look, marked, looks.moving)
    return Looks(depth, marked, jaxlie.SE3(jnp.where(is_look, poses, old)))


@full_precision
def find_movers(
    looks: Looks,
    view: Observation,
    T_previous_camera: jaxlie.SE3,
    estimate: PoseEstimate,
    camera: Camera,
    config: MotionConfig,
) -> Bool[Array, "p"]:
    """Which valid points of a frame move.

    A look at a point of depth z is compared with the depths d round its pixel there: with g the distance to them in
    standard deviations, its log-likelihood ratio of static to moving is hit - g²/2. Before them, in free space, it is
    -miss at the least, since either prediction may be wrong; behind them it is not seen, and 0 at the least. The
    variance of z - d is that of both depths, 2 (ν z)², and what the pose of the frame may err at that distance. What no
    look saw is static.

    Depths of a network drift: what stands comes nearer by some percent a frame, until all older looks see through it.
    What moves leaves free space from one look to the next. With j the largest step, in standard deviations, of the free
    space behind a point from one look to the one before that, the log-odds of static are prior + hit - j²/2 at least.

    Args:
        view: camera frame, in the map's unit.
        T_previous_camera: from this camera to that of the last frame.
        estimate: of this pose, with the noise ν of depths; where that is 0 it is not known, and nothing moves.
    """
    pose_variance = jnp.diagonal(estimate.covariance)
    shift, turn = jnp.mean(pose_variance[:3]), jnp.mean(pose_variance[3:6])

    def compare(
        look: tuple[Float[Array, "2 p"], Bool[Array, "p"], Float[Array, "7"]],
    ) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
        """Log-likelihood ratio of a look, and the free space that it shows behind each point; 0 where it shows none."""
        (nearest, farthest), moving, T_previous_look = look[0], look[1], jaxlie.SE3(look[2])
        pixels, z = project(camera, (T_previous_look.inverse() @ T_previous_camera) @ view.points)
        index, inside = nearest_pixel(pixels, (camera.height, camera.width))
        std = jnp.sqrt(2.0 * (estimate.depth_noise * z) ** 2 + shift + turn * z**2)
        std = jnp.maximum(std, NEAREST_DEPTH)
        before, behind = (jnp.maximum(gap, 0.0) / std for gap in (nearest[index] - z, z - farthest[index]))
        found = jnp.maximum(config.hit - 0.5 * (before + behind) ** 2, jnp.where(before > 0, -config.miss, 0.0))
        found = jnp.where(moving[index], jnp.minimum(found, 0.0), found)
        is_seen = inside & (z > NEAREST_DEPTH) & (nearest[index] > 0)
        return jnp.where(is_seen, found, 0.0), jnp.where(is_seen, before, 0.0)

    ratios, free = jax.vmap(compare)((looks.depth, looks.moving, looks.T_previous_look.wxyz_xyz))
    step = jnp.max(jnp.diff(jax.lax.cummax(free), axis=0, prepend=0.0), axis=0)
    standing, drifting = jnp.sum(ratios, axis=0), config.hit - 0.5 * step**2
    log_odds = jnp.where(view.valid, config.prior + jnp.maximum(standing, drifting), 0.0)
    most = config.miss * looks.depth.shape[0]
    limited = jnp.clip(log_odds, -most, most)
    return view.valid & (_box_sum(limited, camera, config.radius) < 0) & (estimate.depth_noise > 0)


def _box_sum(values: Float[Array, "p"], camera: Camera, radius: int) -> Float[Array, "p"]:
    window = (2 * radius + 1,) * 2
    image = values.reshape(camera.height, camera.width)
    return jax.lax.reduce_window(image, 0.0, jax.lax.add, window, (1, 1), "SAME").reshape(-1)
