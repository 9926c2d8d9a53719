"""Layers: two maps of one scene have independent errors, so their surfaces lie apart until they are made one layer."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emgs_jax.existence import ExistenceConfig, along_surface, nearest_layer
from emgs_jax.gaussian_map import GaussianMap, without
from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.linalg import outer, safe_normalize
from emgs_jax.ops.neighbours import knn
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import where_rows

MAX_APART_SQ = 9.0  # squared Mahalanobis distance between layers of one surface, a frame's noise included


@full_precision
def one_layer(
    map: GaussianMap,
    is_other: Bool[Array, "n"],
    origins: Float[Array, "n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> GaussianMap:
    """Make one layer of two maps that lie on each other: move both together, then fuse the second into the first.

    Args:
        map: the Gaussians of both, world frame.
        is_other: the Gaussians of the second map.
        origins: centre of the camera that made each, world frame.
        depth_noise: as a fraction of the depth.
        config: gates; with `max_layer_sq` 0 the map stays as it is.
    """
    return _fused(_together(map, is_other, origins, depth_noise, config), is_other, origins, depth_noise, config)


def _together(
    map: GaussianMap,
    is_other: Bool[Array, "n"],
    origins: Float[Array, "n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> GaussianMap:
    """Move every Gaussian by half of the local difference of the maps: μ_i' = μ_i + ½ n_i mean_j n_j·(μ_j' - μ_j).

    The mean is over the Gaussian and its nearest neighbours of the same map and normal, so that no surface tears. μ_j'
    is the mean of the other map's layer at Gaussian j; without one the term is 0.
    """
    gaussians, known = map.gaussians, replace(config, max_mahalanobis_sq=MAX_APART_SQ * (config.max_layer_sq > 0))

    def offsets(own: Bool[Array, "n"], of_other: Bool[Array, "n"]) -> Float[Array, "n"]:
        layer, has_layer = nearest_layer(map, own, of_other, origins, depth_noise, known)
        apart = jnp.sum(gaussians.normals * (gaussians.means[layer] - gaussians.means), axis=-1)
        rows, exists = knn(gaussians.means, gaussians.means, own, min(config.num_neighbours, own.shape[0]), own)
        normals = jnp.einsum("ni,nki->nk", gaussians.normals, gaussians.normals[rows])
        is_alike = exists & (normals >= config.min_normal_cos)
        total = jnp.sum(jnp.where(is_alike, jnp.where(has_layer, apart, 0.0)[rows], 0.0), axis=-1)
        return total / jnp.maximum(jnp.sum(is_alike, axis=-1), 1)

    first, other = gaussians.valid & ~is_other, gaussians.valid & is_other
    half = 0.5 * jnp.where(is_other, offsets(other, first), offsets(first, other))
    means = gaussians.means + half[:, None] * gaussians.normals
    return eqx.tree_at(lambda m: m.gaussians.means, map, jnp.where(gaussians.valid[:, None], means, gaussians.means))


def _fused(
    map: GaussianMap,
    is_other: Bool[Array, "n"],
    origins: Float[Array, "n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> GaussianMap:
    """Fuse Gaussians of the second map into those of the first from which they cannot be told apart.

    One Gaussian may take several, as it does points. Means, colours and normals are averaged by weight; the covariance
    grows by the spread along the surface only.
    """
    old, count = map.gaussians, is_other.shape[0]
    first, other = old.valid & ~is_other, old.valid & is_other
    layer, is_one = nearest_layer(map, other, first, origins, depth_noise, config)
    to = jnp.where(is_one, layer, jnp.arange(count))  # its own row if it is fused into none

    def total(values: Array) -> Array:
        return jnp.zeros_like(values).at[to].add(values)

    def mean(values: Array) -> Array:
        weight = map.weight.reshape(-1, *[1] * (values.ndim - 1))
        return total(weight * values) / jnp.maximum(total(weight), jnp.finfo(jnp.float32).tiny)

    means, normals = mean(old.means), safe_normalize(mean(old.normals))
    along = along_surface(old.means - means[to], normals[to])
    features = old.features + config.feature * (total(old.features) - old.features)
    fused = GaussianMap(
        gaussians=Gaussians(means, mean(old.covs + outer(along)), mean(old.colors), normals, features, old.valid),
        weight=total(map.weight),
        num_updates=total(map.num_updates),
        existence=map.existence.at[to].max(map.existence),
        birth=map.birth,
    )
    has_taken = total(jnp.ones(count, jnp.int32)) > 1
    return without(where_rows(has_taken, fused, map), is_one)
