"""Expectation-maximisation map update (Method D, eq. 2 to 4): aligned points update the Gaussians that explain them."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import AverageConfig, GaussianMap, update_average
from emgs_jax.gaussians import GaussianIndex, Gaussians, gathered_features, has_feature, index_of
from emgs_jax.observation import Observation, sound
from emgs_jax.ops.linalg import (
    Whitening,
    across,
    between,
    dot,
    down,
    floored,
    outer,
    principal_axes_2x2,
    safe_normalize,
    tangent_basis,
    whiten,
    widened_distance_sq,
)
from emgs_jax.ops.neighbours import Nearby, among_nearest, nearby, of_queries
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, join_rows, split_rows, static, take_rows, traced, where_rows

BLOCK = 16  # points that share a list of Gaussians
MAX_BLOCKS = 8192  # whose explanations are held at once
LEAST_SHARE = 1e-18  # of a point; a smaller sum of them counts as none, since the slopes of a ratio would overflow


class EmConfig(eqx.Module):
    """Gates, weights and readings of the update.

    Args:
        num_neighbours: K, nearest Gaussians per point.
        num_candidates: Gaussians near a block of points, among which the K of each point are searched.
        min_normal_cos: τ_n, on the mean over the neighbours of n_k · n_i.
        max_mahalanobis_sq: τ_Σ, on the smallest squared Mahalanobis distance (R1).
        max_log_gap: τ_π, on the gap between the best possible log-joint and the best one found; `inf` as printed (R3).
        determinant_weight: of -log|Σ|; 1 printed, 0.5 a Gaussian's (R2).
        normal_weight: κ1.
        feature_weight: κ2.
        support: δ as `printed`, clipped to 1, or `normalized` by the total responsibility (R5).
        average: gain and blend (R4, R13).
        feature: a Gaussian keeps its first one (`medoid`, printed), or sums those of all frames, `accumulated` (R16).
        noise: factor on a point's noise along its viewing ray, which widens every Gaussian that it is compared with; 0
            as printed.
        min_responsibility: a Gaussian that receives less in total from a frame stays unchanged.
        min_std: m; floor of the new covariances.
    """

    num_neighbours: int = static(low=1, high=256)
    min_normal_cos: Float[Array, "*b"] = traced(low=-math.inf, high=1)
    max_mahalanobis_sq: Float[Array, "*b"] = traced(low=0, high=math.inf)
    max_log_gap: Float[Array, "*b"] = traced(low=0, high=math.inf)
    determinant_weight: Float[Array, "*b"] = traced(low=0, high=1000)
    normal_weight: Float[Array, "*b"] = traced(low=0)
    feature_weight: Float[Array, "*b"] = traced(low=0)
    support: Float[Array, "*b"] = choice("printed", "normalized")
    average: AverageConfig
    feature: Float[Array, "*b"] = choice("medoid", "accumulated")
    noise: Float[Array, "*b"] = traced(low=0)
    min_std: Float[Array, "*b"] = traced(low=1e-6, high=1000)
    num_candidates: int = static(48, low=1, high=384)
    min_responsibility: Float[Array, "*b"] = traced(1.0, low=0)


class EStep(eqx.Module):
    """Data association of points with Gaussians, in blocks of neighbouring points.

    Args:
        near: the Gaussians near each block of points.
        responsibilities: r^ik of the points of each block. Over its Gaussians they sum to 1, or to 0 for a point that
            takes no part; only the K nearest of a point are not 0.
        is_fused: the points that pass every gate, in the order of the points.
    """

    near: Nearby
    responsibilities: Float[Array, "b q c"]
    is_fused: Bool[Array, "m"]


def owners(step: EStep, num_gaussians: int) -> Int[Array, "m"]:
    """Find the Gaussian that explains each point best; `num_gaussians` where none does."""
    best = jnp.argmax(step.responsibilities, axis=-1)
    rows = jnp.take_along_axis(step.near.rows, best, axis=-1)
    rows = jnp.where(jnp.any(step.responsibilities > 0, axis=-1), rows, num_gaussians)
    return of_queries(step.near, rows, step.is_fused.shape[0])


class EmInfo(eqx.Module):
    """Statistics of one update: counts, and the mean log-joint of the fused points."""

    num_points: Int[Array, ""]
    num_fused: Int[Array, ""]
    num_updated: Int[Array, ""]
    mean_log_joint: Float[Array, ""]


@full_precision
def e_step(
    gaussians: Gaussians,
    points: Observation,
    noise: Float[Array, "m 3"],
    config: EmConfig,
    index: GaussianIndex | None = None,
) -> tuple[EStep, Float[Array, "m"]]:
    """Compute the responsibilities of the K nearest Gaussians for every point (eq. 2 and 3), and its best log-joint.

    Args:
        gaussians: n of them, world frame.
        points: m observed points, world frame.
        noise: m; standard deviation of every point along its viewing ray, as a vector.
        index: of the Gaussians; None builds it here.
    """
    return _e_step(gaussians, *_sound(points, noise), config, index_of(gaussians) if index is None else index)


def _sound(points: Observation, noise: Float[Array, "m 3"]) -> tuple[Observation, Float[Array, "m 3"]]:
    """Invalidate points whose noise is not finite."""
    has_noise = jnp.all(jnp.isfinite(noise), axis=-1)
    points = sound(eqx.tree_at(lambda o: o.valid, points, points.valid & has_noise))
    return points, jnp.where(points.valid[:, None], noise, 0.0)


def _e_step(
    gaussians: Gaussians, points: Observation, noise: Float[Array, "m 3"], config: EmConfig, index: GaussianIndex
) -> tuple[EStep, Float[Array, "m"]]:
    """Do the E-step for points with finite noise."""
    near = nearby(points.points, points.valid, index.groups, config.num_candidates, BLOCK)
    meaning = eqx.tree_at(lambda g: g.features, gaussians, safe_normalize(gaussians.features))
    table = meaning, index.white
    blocks, noise = take_rows((points, noise), near.queries)
    # The last block may have fewer points.
    blocks = eqx.tree_at(lambda o: o.valid, blocks, blocks.valid & (near.queries < points.valid.shape[0]))
    parts = split_rows((near, blocks, noise), MAX_BLOCKS)
    explained = jax.lax.map(lambda part: _explain(table, *part, config), parts)
    responsibilities, is_fused, best = join_rows(explained, near.rows.shape[0])
    is_fused, best = (of_queries(near, values, points.valid.shape[0]) for values in (is_fused, best))
    return EStep(near, responsibilities, is_fused), best


def _explain(
    table: tuple[Gaussians, Whitening],
    near: Nearby,
    points: Observation,
    noise: Float[Array, "b q 3"],
    config: EmConfig,
) -> tuple[Float[Array, "b q c"], Bool[Array, "b q"], Float[Array, "b q"]]:
    """Do the E-step for blocks: compare every point of a block with each Gaussian near the block."""
    gaussians, (triangles, logdets) = take_rows(table, near.rows)
    offsets = between(points.points, gaussians.means)
    ray, normals = (down(vectors) for vectors in (config.noise * noise, points.normals))
    found = among_nearest(dot(offsets, offsets), near.exists[:, None], config.num_neighbours)
    distance_sq, log_growth = widened_distance_sq(*(whiten(across(triangles), x) for x in (offsets, ray)))
    normal_cos = dot(across(gaussians.normals), normals)
    # If either feature is missing, the term must vanish.
    feature_gap = 0.0
    if gaussians.features.shape[-1]:
        both = has_feature(points.features)[:, :, None] & has_feature(gaussians.features)[:, None]
        cosine = jnp.einsum("bqf,bcf->bqc", points.features, gaussians.features)
        feature_gap = jnp.where(both, cosine - 1.0, 0.0)
    log_det_term = -config.determinant_weight * (logdets[:, None] + log_growth)
    log_joint = -0.5 * distance_sq + log_det_term
    log_joint += config.normal_weight * (normal_cos - 1.0) + config.feature_weight * feature_gap

    has_neighbour = jnp.any(found, axis=-1)
    some = found | ~has_neighbour[..., None]  # a reduction over nothing has no value; these points are masked below
    best = jnp.max(jnp.where(some, log_joint, -jnp.inf), axis=-1)
    log_gap = jnp.max(jnp.where(some, log_det_term, -jnp.inf), axis=-1) - best
    mean_cos = jnp.sum(jnp.where(found, normal_cos, 0.0), axis=-1) / jnp.maximum(jnp.sum(found, axis=-1), 1)
    nearest_sq = jnp.min(jnp.where(some, distance_sq, jnp.inf), axis=-1)
    is_fused = points.valid & has_neighbour & (mean_cos >= config.min_normal_cos)
    is_fused &= (nearest_sq <= config.max_mahalanobis_sq) & (log_gap <= config.max_log_gap)
    return jax.nn.softmax(log_joint, axis=-1, where=some) * is_fused[..., None], is_fused, best


def support(gaussians: Gaussians, points: Observation, step: EStep, config: EmConfig) -> Float[Array, "n"]:
    """Compute δ_k in [0, 1]: how evenly points lie on both sides of a Gaussian along its tangential principal axes.

    For each axis 2 min(Σ₊ r, Σ₋ r), divided by the total or clipped (R5); δ is the smaller value of the two axes.
    """
    basis = tangent_basis(gaussians.normals)
    plane_covs = jnp.einsum("nda,ndc,ncb->nab", basis, gaussians.covs, basis)
    axes = jnp.einsum("nda,nab->ndb", basis, principal_axes_2x2(plane_covs))
    near_means, near_axes = take_rows((gaussians.means, axes), step.near.rows)
    offsets = between(take_rows(points.points, step.near.queries), near_means)
    r, sides = step.responsibilities, []
    for axis in jnp.unstack(near_axes, axis=-1):
        is_positive = dot(offsets, across(axis)) > 0
        sides += [jnp.sum(jnp.where(is_positive, r, 0.0), axis=1), jnp.sum(jnp.where(is_positive, 0.0, r), axis=1)]
    sums = jnp.zeros((gaussians.valid.shape[0], 4)).at[step.near.rows].add(jnp.stack(sides, axis=-1))
    first, second = sums[:, 0::2], sums[:, 1::2]
    smaller, total = 2.0 * jnp.minimum(first, second), first + second
    has_share = total > LEAST_SHARE
    normalized = jnp.where(has_share, smaller, 0.0) / jnp.where(has_share, total, 1.0)
    both = jnp.where(config.support > 0, normalized, jnp.minimum(smaller, 1.0))
    return jnp.min(both, axis=-1)


def precision(noise: Float[Array, "m 3"], config: EmConfig) -> Float[Array, "m"]:
    """Weigh points by their noise: min_std² / (min_std² + (`config.noise` |ν|)²) in (0, 1], 1 for an exact point."""
    return config.min_std**2 / (config.min_std**2 + config.noise**2 * jnp.sum(noise**2, axis=-1))


@full_precision
def m_step(
    gaussians: Gaussians, points: Observation, weights: Float[Array, "m"], step: EStep, config: EmConfig
) -> tuple[Gaussians, Float[Array, "n"]]:
    """Compute mean, covariance, normal and colour of the points of every Gaussian, weighted by responsibility.

    A point counts r_ik times its weight, see `precision`.

    Returns:
        The new parameters (the old ones for a Gaussian without points), and the total responsibility Σ_i r_ik.
    """
    blocks = take_rows((points, weights), step.near.queries)
    sums = _statistics(gaussians.means[step.near.rows], *blocks, step.responsibilities)
    sums = jnp.zeros((gaussians.valid.shape[0], 17)).at[step.near.rows].add(sums)
    total = sums[:, 0]
    has_points = (total > config.min_responsibility) & (sums[:, 1] > LEAST_SHARE)
    mean = jnp.where(has_points[:, None], sums[:, 2:], 0.0) / jnp.where(has_points, sums[:, 1], 1.0)[:, None]
    rows, columns = jnp.triu_indices(3)
    second = jnp.zeros((total.shape[0], 3, 3)).at[:, rows, columns].set(mean[:, 3:9])
    second = second.at[:, columns, rows].set(mean[:, 3:9])
    new = eqx.tree_at(
        lambda g: (g.means, g.covs, g.normals, g.colors),
        gaussians,
        (
            gaussians.means + mean[:, :3],
            floored(second - outer(mean[:, :3]), config.min_std),
            safe_normalize(mean[:, 9:12]),
            mean[:, 12:],
        ),
    )
    return where_rows(has_points, new, gaussians), jnp.where(has_points, total, 0.0)


def _statistics(
    means: Float[Array, "b c 3"],
    points: Observation,
    weights: Float[Array, "b q"],
    responsibilities: Float[Array, "b q c"],
) -> Float[Array, "b c 17"]:
    """Sum r and r w (1, offset, upper triangle of offset offset', normal, colour) over the points of every block."""
    weighted = responsibilities * weights[..., None]
    # Offsets from the old means: second moments of world coordinates would cancel in float32.
    offsets = between(points.points, means)
    products = [offsets[row] * offsets[column] for row in range(3) for column in range(row, 3)]
    moments = [jnp.sum(weighted * value, axis=1) for value in (*offsets, *products)]
    totals = [jnp.sum(responsibilities, axis=1), jnp.sum(weighted, axis=1)]
    others = jnp.einsum("bqc,bqv->bcv", weighted, jnp.concatenate([points.normals, points.colors], axis=-1))
    return jnp.concatenate([jnp.stack([*totals, *moments], axis=-1), others], axis=-1)


def _with_features(submap: GaussianMap, points: Observation, step: EStep, config: EmConfig) -> GaussianMap:
    """Add each point's feature, which may be wide, to the Gaussian that explains the point best."""
    features = submap.gaussians.features
    owner = owners(step, features.shape[0])[:, None]
    said = gathered_features(points.features, owner, config.feature * jnp.ones(owner.shape), features.shape[0])
    return eqx.tree_at(lambda m: m.gaussians.features, submap, features + said)


@full_precision
def em_update(
    submap: GaussianMap,
    aligned: Observation,
    noise: Float[Array, "m 3"],
    config: EmConfig,
    index: GaussianIndex | None = None,
    e_step: Callable[..., tuple[EStep, Array]] = _e_step,
) -> tuple[GaussianMap, EStep, EmInfo]:
    """Do one incremental EM step: fuse the points of `aligned` (world frame) that the submap explains.

    `noise` is the standard deviation of each point along its viewing ray, a vector in metres;
    `index` is that of the submap. Another function can replace `e_step`.

    Returns:
        The updated submap, the data association, and statistics. Without any fused point the submap is unchanged.
    """
    gaussians, (aligned, noise) = submap.gaussians, _sound(aligned, noise)
    index = index_of(gaussians) if index is None else index
    step, best = e_step(gaussians, aligned, noise, config, index)
    new, total = m_step(gaussians, aligned, precision(noise, config), step, config)
    evidence = jnp.where(total > 0, support(gaussians, aligned, step, config), 0.0)
    updated, gain = update_average(submap, new, evidence, config.average)
    updated = _with_features(updated, aligned, step, config)
    num_fused = jnp.sum(step.is_fused)
    info = EmInfo(
        num_points=jnp.sum(aligned.valid),
        num_fused=num_fused,
        num_updated=jnp.sum(gain > 0),
        mean_log_joint=jnp.sum(jnp.where(step.is_fused, best, 0.0)) / jnp.maximum(num_fused, 1),
    )
    return updated, step, info
