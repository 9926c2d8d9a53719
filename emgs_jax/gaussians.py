"""Gaussians with colour, normal and feature, and how points become them (eq. 1)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.observation import Observation, sound
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.clustering import kmeans, strided_seeds
from emgs_jax.ops.executable import executable
from emgs_jax.ops.linalg import (
    Whitening,
    dot,
    floored,
    inverse_2x2,
    outer,
    safe_normalize,
    tangent_basis,
    whiten,
    whitening,
)
from emgs_jax.ops.neighbours import Groups, group_points, nearest, order_of
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, static, take_rows, traced, where_rows

MIN_ROWS = 4  # fewer have no covariance
REFERENCE = 518 * 392  # pixels of the images in which λ counts
LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601


class Gaussians(eqx.Module):
    """Gaussians in the world frame. Invalid rows are neutral: origin, unit covariance, zero normal."""

    means: Float[Array, "*b n 3"]  # μ, m
    covs: Float[Array, "*b n 3 3"]  # Σ, m²; every eigenvalue is at least min_std²
    colors: Float[Array, "*b n 3"]  # c, RGB in [0, 1]
    normals: Float[Array, "*b n 3"]  # n̄, unit
    features: Float[Array, "*b n f"]  # f; its direction is the meaning; zero = unknown
    valid: Bool[Array, "*b n"]


class GaussianIndex(eqx.Module):
    """Search index of Gaussians, built once for all stages."""

    white: Whitening  # of the covariances
    groups: Groups  # of the means of the valid ones


def index_of(gaussians: Gaussians) -> GaussianIndex:
    """Index the Gaussians of a submap."""
    return GaussianIndex(whitening(gaussians.covs), group_points(gaussians.means, gaussians.valid))


def empty_gaussians(capacity: int, num_features: int) -> Gaussians:
    """`capacity` invalid rows."""
    return Gaussians(
        means=jnp.zeros((capacity, 3)),
        covs=jnp.broadcast_to(jnp.eye(3), (capacity, 3, 3)),
        colors=jnp.zeros((capacity, 3)),
        normals=jnp.zeros((capacity, 3)),
        features=jnp.zeros((capacity, num_features)),
        valid=jnp.zeros(capacity, bool),
    )


class FitConfig(eqx.Module):
    """Conversion of points into Gaussians: number of clusters, clustering and covariances.

    Args:
        points_per_gaussian: λ, pixels per new Gaussian, counted in an image of the paper's size, 518 × 392. An image of
            another size is cut into as many pieces, but none of fewer than MIN_ROWS points.
        num_fit_neighbours: M of eq. 1 (R10).
        min_std: m; floor of a Gaussian's standard deviation in every direction.
        feature: the `medoid` of the points' features (printed), or `accumulated`: their sum, to which EM and refinement
            add those of other frames (R16).
    """

    points_per_gaussian: int = static(low=1, high=2**20)
    num_fit_neighbours: int = static(low=MIN_ROWS, high=256)
    min_std: Float[Array, "*b"] = traced(low=1e-6, high=1000)
    feature: Float[Array, "*b"] = choice("medoid", "accumulated")
    num_kmeans_iterations: int = static(5, low=0, high=1000)


def spacing(camera: Camera, thin: int, config: FitConfig) -> int:
    """Compute how many rows of a thinned observation make one Gaussian: λ pixels of an image of 518 × 392."""
    share = camera.width * camera.height / REFERENCE
    return max(round(config.points_per_gaussian * share / thin**2), MIN_ROWS)


@full_precision
def fit_to_points(
    centers: Float[Array, "k 3"], exists: Bool[Array, "k"], observation: Observation, config: FitConfig
) -> Gaussians:
    """Fit covariance, normal, feature and colour of each centre to its M nearest points (eq. 1).

    min_std² is added to the diagonal of the covariance, so every eigenvalue is at least that. A centre with fewer than
    four points becomes invalid.
    """
    return _fit_to_sound(centers, exists, sound(observation), config)


def _fit_to_sound(
    centers: Float[Array, "k 3"], exists: Bool[Array, "k"], observation: Observation, config: FitConfig
) -> Gaussians:
    points, num = observation.points, config.num_fit_neighbours
    groups = group_points(points, observation.valid)
    # A centre stands for several points, so few centres share a list and the list is long.
    rows, found = nearest(centers, exists, points, groups, num, size=4, count=6 * num)
    valid = exists & (jnp.sum(found, axis=-1) >= 4)
    found |= ~valid[:, None]  # a softmax over nothing would be NaN; these rows are masked below
    near = jax.tree.map(lambda leaf: leaf[rows], observation)
    count = jnp.maximum(jnp.sum(found, axis=-1), 1)[:, None]
    offsets = jnp.where(found[..., None], near.points - centers[:, None], 0.0)
    centered = jnp.where(found[..., None], offsets - (jnp.sum(offsets, axis=1) / count)[:, None], 0.0)
    covs = floored(jnp.sum(outer(centered), axis=1) / count[..., None], config.min_std)
    triangle = jnp.unstack(whitening(covs)[0][:, None], axis=-1)
    white = whiten(triangle, jnp.unstack(offsets, axis=-1))
    weights = jax.nn.softmax(-0.5 * dot(white, white), axis=-1, where=found)
    mean_feature = jnp.einsum("km,kmf->kf", weights, near.features)
    is_known = found & has_feature(near.features)
    closeness = jnp.where(is_known, jnp.einsum("kmf,kf->km", near.features, mean_feature), -jnp.inf)
    medoid = jnp.take_along_axis(near.features, jnp.argmax(closeness, axis=-1)[:, None, None], axis=1)[:, 0]
    fitted = Gaussians(
        means=centers,
        covs=covs,
        colors=jnp.einsum("km,kmc->kc", weights, near.colors),
        normals=safe_normalize(jnp.einsum("km,kmd->kd", weights, near.normals)),
        features=jnp.where(config.feature > 0, mean_feature, medoid),
        valid=valid,
    )
    return where_rows(valid, fitted, empty_gaussians(centers.shape[0], observation.features.shape[-1]))


@executable
@full_precision
def cluster(
    observation: Observation, order: Int[Array, "p"], spacing: int, config: FitConfig
) -> tuple[Gaussians, Float[Array, "g"]]:
    """Cluster the valid points into Gaussians: k-means from every `spacing`-th point along `order`, then eq. 1.

    The M neighbours of eq. 1 come from an even subset of the points, in which a cluster has about M of them. So a
    Gaussian is as large as its cluster, however many images were merged. Compiled on its own, because the first map and
    every step share it.

    Returns:
        ceil(p / spacing) Gaussians, and the number of points of each in units of `spacing`; 0 where invalid.
    """
    observation = sound(observation)
    num_points, num_neighbours = order.shape[0], config.num_fit_neighbours
    num_seeds = -(-num_points // spacing)
    seeds, seed_exists = strided_seeds(observation.valid, order, spacing, num_seeds)
    centers, exists, count = kmeans(
        observation.points, observation.valid, observation.points[seeds], seed_exists, config.num_kmeans_iterations
    )
    stride = max(spacing // num_neighbours, 1)
    rows, row_exists = strided_seeds(observation.valid, order, stride, -(-num_points // stride))
    even = take_rows(observation, rows)
    even = eqx.tree_at(lambda o: o.valid, even, even.valid & row_exists)
    fitted = _fit_to_sound(centers, exists, even, config)
    evidence = jnp.where(config.feature > 0, count, 1.0)[:, None] * fitted.features
    fitted = eqx.tree_at(lambda g: g.features, fitted, jnp.where(fitted.valid[:, None], evidence, 0.0))
    return fitted, jnp.where(fitted.valid, count / spacing, 0.0)


def blend(old: Gaussians, new: Gaussians, gain: Float[Array, "n"], moment_matched: Float[Array, ""]) -> Gaussians:
    """Blend means, covariances, colours and normals: (1 - gain) old + gain new (eq. 4 and 6); features stay (R13).

    Args:
        moment_matched: 0 = the printed linear blend of covariances; 1 adds gain (1 - gain) Δ Δ' for the difference Δ of
            the means, which gives the covariance of the moment-matched mixture.
    """
    weight = gain[:, None]
    difference = new.means - old.means
    spread = moment_matched * (gain * (1.0 - gain))[:, None, None] * outer(difference)
    return eqx.tree_at(
        lambda g: (g.means, g.covs, g.colors, g.normals),
        old,
        (
            old.means + weight * difference,
            old.covs + weight[..., None] * (new.covs - old.covs) + spread,
            old.colors + weight * (new.colors - old.colors),
            safe_normalize(old.normals + weight * (new.normals - old.normals)),
        ),
    )


def has_feature(features: Float[Array, "*b f"]) -> Bool[Array, "*b"]:
    """Tell which features exist; a missing one is zero and counts as neither similar nor different."""
    return jnp.any(features != 0, axis=-1)


def gathered_features(
    features: Float[Array, "m f"], rows: Int[Array, "m k"], weights: Float[Array, "m k"], num_rows: int
) -> Float[Array, "n f"]:
    """Sum the weighted features of each of n rows; row numbers past the end are dropped."""
    sums = jnp.zeros((num_rows, features.shape[-1]))
    return sums.at[rows].add(weights[..., None] * features[:, None], mode="drop")


def intensity(colors: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Convert RGB to luminance."""
    return colors @ jnp.array(LUMINANCE, colors.dtype)


def color_gradients(gaussians: Gaussians, num_neighbours: int, groups: Groups | None = None) -> Float[Array, "n 3"]:
    """Fit the intensity gradient (1/m) of every Gaussian in its tangent plane to its neighbours; orthogonal to n.

    `groups` are those of the valid means, see `group_points`; None builds them here.
    """
    means, valid = gaussians.means, gaussians.valid
    groups = group_points(means, valid) if groups is None else groups
    rows, found = nearest(means, valid, means, groups, num_neighbours, order=order_of(groups, valid.shape[0]))
    basis = tangent_basis(gaussians.normals)
    offsets = jnp.einsum("nkd,nda->nka", gaussians.means[rows] - gaussians.means[:, None], basis)
    offsets = jnp.where(found[..., None], offsets, 0.0)
    light = intensity(gaussians.colors)
    moments = jnp.einsum("nka,nkb->nab", offsets, offsets)
    cross = jnp.einsum("nka,nk->na", offsets, light[rows] - light[:, None])
    # A hundredth of the spread keeps the fit of collinear neighbours finite, the own widths that of coincident ones.
    own = jnp.trace(gaussians.covs, axis1=-2, axis2=-1)
    ridge = 0.01 * jnp.trace(moments, axis1=-2, axis2=-1) + 1e-5 * own
    slopes = (inverse_2x2(moments + ridge[:, None, None] * jnp.eye(2)) @ cross[..., None])[..., 0]
    return jnp.einsum("nda,na->nd", basis, slopes)
