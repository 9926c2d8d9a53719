"""Layers: surfaces that are one, but lie apart by the errors of the frames that made them, become one.

Two maps of one scene have independent errors (`one_layer`). Within one map, frames that are far apart in time, or at
the border of what a network sees well, may have made a second sheet of a surface (`fuse_sheets`).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.existence import MIN_GAP, ExistenceConfig, along_surface, nearest_layer
from emgs_jax.gaussian_map import GaussianMap, without
from emgs_jax.gaussians import Gaussians, has_feature
from emgs_jax.ops.linalg import inner, lower_entries, outer, quadratic, safe_normalize, whiten, whitened_entries
from emgs_jax.ops.neighbours import group_points, knn, nearest, order_of
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import where_rows

MAX_APART_SQ = 9.0  # squared Mahalanobis distance between layers of one surface, a frame's noise included
MAX_CROSSING_SQ = 3.0  # where a ray crosses a Gaussian, at most: half the width of an even patch is √3 σ
NUM_NEAR = 24  # Gaussians among which a second sheet is searched, those of the own one included


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
    """Fuse Gaussians of the second map into those of the first from which they cannot be told apart."""
    old = map.gaussians
    first, other = old.valid & ~is_other, old.valid & is_other
    return _fused_into(map, *nearest_layer(map, other, first, origins, depth_noise, config), config)


def _fused_into(
    map: GaussianMap, layer: Int[Array, "n"], is_one: Bool[Array, "n"], config: ExistenceConfig
) -> GaussianMap:
    """Fuse each Gaussian in `is_one` into that of row `layer`, which is itself fused into none.

    One Gaussian may take several, as it does points. Means, colours and normals are averaged by weight; the covariance
    grows by the spread along the surface only.
    """
    old, count = map.gaussians, is_one.shape[0]
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
        num_through=map.num_through,
    )
    has_taken = total(jnp.ones(count, jnp.int32)) > 1
    return without(where_rows(has_taken, fused, map), is_one)


@full_precision
def fuse_sheets(
    map: GaussianMap, origins: Float[Array, "n 3"], depth_noise: Float[Array, ""], config: ExistenceConfig
) -> GaussianMap:
    """Fuse the sheets of a surface: pairs of Gaussians of which the one behind was seen through the one in front.

    A frame looks for what it sees through among the Gaussians that exist (`update_existence`). A Gaussian that is born
    later, in front of an earlier one, was never asked about: the frame that made the earlier one looked through the
    place of the later, and later frames take the earlier one for occluded. In a world that stands still at most one of
    both is right. If they differ by no more than the errors of two frames, they are sheets of one surface, and the one
    of fewer frames is fused into the other. Two surfaces that are as near, a book and the desk that it lies on, stay:
    no frame saw one through the other.

    Args:
        map: all Gaussians, world frame.
        origins: centre of the camera that made each, world frame.
        depth_noise: ν, as a fraction of the depth.
        config: gates; with `max_layer_sq` 0 the map stays as it is.
    """

    def once(state: tuple[GaussianMap, Bool[Array, ""]]) -> tuple[GaussianMap, Bool[Array, ""]]:
        map, _ = state
        sheet, is_one = _nearest_sheet(map, origins, depth_noise, config)
        is_one &= ~is_one[sheet]
        return _fused_into(map, sheet, is_one, config), jnp.any(is_one)

    is_on = config.max_layer_sq > 0
    return jax.lax.while_loop(lambda state: state[1], once, (map, jnp.asarray(is_on)))[0]


def _nearest_sheet(
    map: GaussianMap, origins: Float[Array, "n 3"], depth_noise: Float[Array, ""], config: ExistenceConfig
) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Find for every Gaussian a heavier one that is another sheet of its surface, and whether there is one.

    Let g be the gap along n, the mean of both normals, and σ_i = ν d_i, with d_i the distance of camera i from the
    plane of Gaussian i. They are sheets if g² > `MIN_GAP`² n'Σn of either, so that they are not one thick sheet,
    g² <= `MAX_APART_SQ` (σ_a² + σ_b²), and the ray from the camera that made the one behind crosses the one in
    front within `MAX_CROSSING_SQ`. The nearest is that of the smallest sum of both squared distances.
    """
    gaussians, count = map.gaussians, origins.shape[0]
    groups = group_points(gaussians.means, gaussians.valid)
    k = min(NUM_NEAR, count)
    rows, found = nearest(gaussians.means, gaussians.valid, gaussians.means, groups, k, order=order_of(groups, count))
    triangles, _ = whitened_entries(lower_entries(gaussians.covs))
    own = jnp.arange(count)

    def distance_to(one: tuple[Int[Array, "n"], Bool[Array, "n"]]) -> Float[Array, "n"]:
        """Measure the squared distance to one neighbour of each; infinite if that is no sheet of its surface."""
        near, found = one
        normal = safe_normalize(gaussians.normals + gaussians.normals[near])
        gap = inner(normal, gaussians.means[near] - gaussians.means)
        thickness = [quadratic(lower_entries(gaussians.covs[i]), jnp.unstack(normal, axis=-1)) for i in (own, near)]
        noise = [depth_noise * inner(normal, gaussians.means[i] - origins[i]) for i in (own, near)]
        is_behind = gap**2 > MIN_GAP**2 * jnp.maximum(*thickness)
        apart_sq = gap**2 / (noise[0] ** 2 + noise[1] ** 2)

        front, behind = jnp.where(gap > 0, near, own), jnp.where(gap > 0, own, near)
        ray = gaussians.means[behind] - origins[behind]
        reach = inner(normal, gaussians.means[front] - origins[behind]) / inner(normal, ray)
        crossing = origins[behind] + reach[:, None] * ray - gaussians.means[front]
        white = whiten(tuple(entry[front] for entry in triangles), jnp.unstack(crossing, axis=-1))
        crossing_sq = sum(entry**2 for entry in white)
        is_seen_through = (crossing_sq <= MAX_CROSSING_SQ) & (reach > 0) & (reach < 1)

        is_alike = inner(gaussians.normals, gaussians.normals[near]) >= config.min_normal_cos
        features = gaussians.features, gaussians.features[near]
        is_alike &= ~(has_feature(features[0]) & has_feature(features[1])) | (inner(*features) > 0)
        is_lighter = (map.weight < map.weight[near]) | ((map.weight == map.weight[near]) & (own < near))
        is_sheet = found & gaussians.valid & (near != own) & is_lighter & is_alike & is_behind & is_seen_through
        return jnp.where(is_sheet & (apart_sq <= MAX_APART_SQ), apart_sq + crossing_sq, jnp.inf)

    distance_sq = jax.lax.map(distance_to, (rows.T, found.T))
    sheet = jnp.take_along_axis(rows, jnp.argmin(distance_sq, axis=0)[:, None], axis=1)[:, 0]
    return sheet, jnp.min(distance_sq, axis=0) < jnp.inf
