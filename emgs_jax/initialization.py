"""Initialisation (Method B): the map from the merged predictions of the first window."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from emgs_jax.gaussians import FitConfig, Gaussians, cluster, spacing
from emgs_jax.observation import Observation, sound, sound_poses, transform
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.executable import executable
from emgs_jax.ops.precision import full_precision


@executable
def merge(
    views: Observation, T_world_views: jaxlie.SE3, camera: Camera
) -> tuple[Observation, Observation, Int[Array, "q"]]:
    """Merge the views: in the world frame, as one cloud of q points, and an order that is even over every image.

    A view without a pose contributes no point.
    """
    T_world_views, views = sound_poses(T_world_views), jax.vmap(sound)(views)
    is_known = jnp.all(jnp.isfinite(T_world_views.wxyz_xyz), axis=-1)
    identity = jaxlie.SE3.identity().wxyz_xyz
    T_world_views = jaxlie.SE3(jnp.where(is_known[:, None], T_world_views.wxyz_xyz, identity))
    views = eqx.tree_at(lambda o: o.valid, views, views.valid & is_known[:, None])
    world = jax.vmap(lambda T, view: transform(T, view, jnp.ones(())))(T_world_views, views)
    num_views, num_points = views.valid.shape
    order = morton_order(camera.height, camera.width)
    order = (jnp.arange(num_views)[:, None] * num_points + order).reshape(-1)
    merged = jax.tree.map(lambda leaf: leaf.reshape(num_views * num_points, *leaf.shape[2:]), world)
    return world, merged, order


@full_precision
def initialize(
    views: Observation,
    T_world_views: jaxlie.SE3,
    camera: Camera,
    thin: int,
    config: FitConfig,
) -> tuple[Gaussians, Float[Array, "g"], Observation]:
    """Cluster the merged points of all views: K = num_points / (λ · num_views) Gaussians.

    Args:
        views: camera frames, v views of p points each.
        T_world_views: the prior's poses, which are the map's by construction.
        camera: of the full images.

    Returns:
        The Gaussians, their number of points in units of λ, and the views in the world frame.
    """
    num_views = views.valid.shape[0]
    world, merged, order = merge(views, T_world_views, downscale(camera, thin))
    gaussians, weight = cluster(merged, order, spacing(camera, thin, config) * num_views, config)
    return gaussians, weight * num_views, world
