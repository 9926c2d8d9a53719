"""Rasterisation-based refinement (Method D, eq. 5 and 6): merge what EM left over on the image, or add it."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import AverageConfig, GaussianMap, update_average
from emgs_jax.gaussians import Gaussians, gathered_features, has_feature
from emgs_jax.ops.camera import Camera, nearest_pixel
from emgs_jax.ops.linalg import inverse_2x2, mahalanobis_sq, outer, safe_normalize
from emgs_jax.ops.neighbours import group_points, nearest
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, static, take_rows, traced, where_rows
from emgs_jax.render.composite import RenderConfig, Rendering, render_splats, splat_depth, splats_of
from emgs_jax.render.project import Splats

SQUARES = 1.6  # times the standard deviation of a square; with it 518×392 images, thinned by 2, allow 3 pixels


class RefinementConfig(eqx.Module):
    """Association on the image plane.

    Args:
        num_candidates: K_2D, map Gaussians per candidate.
        max_mahalanobis_sq_2d: τ_Σ2D, on the squared distance under both covariances (R1).
        front_margin: fraction of the depth by which a candidate may lie in front of the map and still be merged; 0 as
            printed (R6).
        back_margin: likewise behind it; `inf` as printed.
        depth_condition: what a candidate's margins refer to: the rendered depth at its own `pixel` (printed), or also
            each Gaussian's plane (`pairs`), so that no pair joins two sides of a depth edge.
        min_normal_cos: pairs whose normals differ more do not merge; `-inf` as printed.
        cosine_weight: share of the features' cosine in ω: 1 as printed; 0: features do not count.
        max_splat_std: pixels of the rendered image; a wider Gaussian of a frame is scattered points, not a surface, and
            is dropped, unless all are as wide, see `without_scattered`; `inf` as printed.
    """

    num_candidates: int = static(low=1, high=256)
    max_mahalanobis_sq_2d: Float[Array, "*b"] = traced(low=0, high=math.inf)
    front_margin: Float[Array, "*b"] = traced(low=0, high=math.inf)
    back_margin: Float[Array, "*b"] = traced(low=0, high=math.inf)
    depth_condition: Float[Array, "*b"] = choice("pixel", "pairs")
    min_normal_cos: Float[Array, "*b"] = traced(low=-math.inf, high=1)
    cosine_weight: Float[Array, "*b"] = traced(low=0, high=1)
    max_splat_std: Float[Array, "*b"] = traced(low=0, high=math.inf)
    render: RenderConfig
    average: AverageConfig
    feature: Float[Array, "*b"] = choice("medoid", "accumulated")


class RefinementInfo(eqx.Module):
    """Counts of one refinement; `overflow` is that of the rendering."""

    num_candidates: Int[Array, ""]
    num_merged: Int[Array, ""]
    num_fresh: Int[Array, ""]
    overflow: Int[Array, ""]


def depth_at(rendering: Rendering, splats: Splats, camera: Camera) -> Float[Array, "g"]:
    """Look up the rendered depth at every splat's mean; 0 if there is none or the mean is outside the image."""
    index, inside = nearest_pixel(splats.means, (camera.height, camera.width))
    return jnp.where(splats.valid & inside, rendering.depth.reshape(-1)[index], 0.0)


def match_on_image(
    map_splats: Splats, candidate_splats: Splats, visible: Bool[Array, "n"], config: RefinementConfig
) -> tuple[Int[Array, "g k"], Float[Array, "g k"], Bool[Array, "g k"]]:
    """Find every candidate's K_2D nearest visible map splats, and squared distances under Σ_map + Σ_candidate."""
    groups = group_points(map_splats.means, visible)
    asked = candidate_splats.means, candidate_splats.valid
    # Candidates may be few and far apart, so few of them share a list and the list is long.
    k = config.num_candidates
    rows, found = nearest(*asked, map_splats.means, groups, k, size=4, count=16 * k)
    covs = map_splats.covs[rows] + candidate_splats.covs[:, None]
    offsets = map_splats.means[rows] - candidate_splats.means[:, None]
    return rows, mahalanobis_sq(offsets, inverse_2x2(covs)), found


def within_margins(
    depth: Float[Array, "*g"], surface: Float[Array, "*g"], config: RefinementConfig
) -> Bool[Array, "*g"]:
    """Test whether a depth is within the margins in front of and behind a surface (fractions of its depth)."""
    relative = depth / surface - 1.0
    return (relative >= -config.front_margin) & (relative <= config.back_margin)


def show_one_surface(
    old: Gaussians,
    candidates: Gaussians,
    map_splats: Splats,
    candidate_splats: Splats,
    rows: Int[Array, "g k"],
    config: RefinementConfig,
) -> Bool[Array, "g k"]:
    """Find pairs whose normals agree, the candidate within the margins of the Gaussian's plane at its pixel."""

    def plane_depth(rows: Int[Array, "k"], pixel: Float[Array, "2"]) -> Float[Array, "k"]:
        return splat_depth(take_rows(map_splats, rows), pixel[None], config.render)[:, 0]

    planes = jax.vmap(plane_depth)(rows, candidate_splats.means)
    depth = jnp.broadcast_to(candidate_splats.depth[:, None], planes.shape)
    is_near = within_margins(depth, planes, config) | (config.depth_condition < 1)
    normal_cos = jnp.einsum("gkd,gd->gk", old.normals[rows], candidates.normals)
    return is_near & (normal_cos >= config.min_normal_cos)


def merge_weights(
    old: Gaussians,
    candidates: Gaussians,
    match: tuple[Int[Array, "g k"], Float[Array, "g k"], Bool[Array, "g k"]],
    on_surface: Bool[Array, "g"],
    config: RefinementConfig,
) -> Float[Array, "g k"]:
    """Compute ω of eq. 5: softmax of -½ d² over the K_2D matches times the features' cosine; 0 for no merge."""
    rows, distance_sq, found = match
    some = found | ~jnp.any(found, axis=-1, keepdims=True)  # a softmax over nothing would be NaN
    omega = jax.nn.softmax(-0.5 * distance_sq, axis=-1, where=some)
    mapped, fresh = (safe_normalize(g.features) for g in (old, candidates))
    cosine = jnp.einsum("gkf,gf->gk", mapped[rows], fresh)
    both = has_feature(candidates.features)[:, None] & has_feature(old.features)[rows]
    share = config.cosine_weight * jnp.maximum(cosine, 0.0) + (1.0 - config.cosine_weight)
    omega = omega * jnp.where(both, share, 1.0)  # opposite features do not merge
    is_match = found & (candidates.valid & on_surface)[:, None] & (distance_sq < config.max_mahalanobis_sq_2d)
    return jnp.where(is_match, omega, 0.0)


def average_candidates(
    candidates: Gaussians, rows: Int[Array, "g k"], weights: Float[Array, "g k"], old: Gaussians
) -> Gaussians:
    """Average the candidates that merge into each map Gaussian, weighted by ω; without any, the old values.

    The covariance is that of the mixture: mean covariance plus the spread of the candidates' means.
    """
    size = old.valid.shape[0]

    def total(values: Float[Array, "g k *d"]) -> Float[Array, "n *d"]:
        return jnp.zeros((size, *values.shape[2:])).at[rows].add(values)

    sums = total(weights)
    share = weights / jnp.where(sums > 0, sums, 1.0)[rows]
    offsets = candidates.means[:, None] - old.means[rows]
    mean_offset = total(share[..., None] * offsets)
    around = offsets - mean_offset[rows]
    covs = total(share[..., None, None] * (candidates.covs[:, None] + outer(around)))
    averaged = eqx.tree_at(
        lambda g: (g.means, g.covs, g.colors, g.normals),
        old,
        (
            old.means + mean_offset,
            covs,
            total(share[..., None] * candidates.colors[:, None]),
            safe_normalize(total(share[..., None] * candidates.normals[:, None])),
        ),
    )
    return where_rows(sums > 0, averaged, old)


def without_scattered(
    new: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, min_std: Float[Array, ""], config: RefinementConfig
) -> Gaussians:
    """Invalidate the new Gaussians of a frame whose splats are wider than `max_splat_std`, as scattered points are.

    The rows of `new` cover an image with n pixels each, and a square of n pixels has a standard deviation of √(n / 6)
    over both axes. `SQUARES` times that is allowed where it is more, as in large images. The floor of covariances,
    `min_std`, does not count: near the camera it alone is wider.

    Args:
        new: Gaussians of one frame, world frame.
        camera: of the images that are rendered.
    """
    splats = splats_of(new, T_world_camera, camera, config.render)
    square = math.sqrt(camera.width * camera.height / (6 * new.valid.shape[0]))
    limit = jnp.maximum(config.max_splat_std, SQUARES * square)
    floor = camera.focal[0] * min_std / splats.depth
    spread_sq = jnp.trace(splats.covs, axis1=-2, axis2=-1) / config.render.covariance_scale - 2.0 * floor**2
    return eqx.tree_at(lambda g: g.valid, new, new.valid & ~(spread_sq > limit**2))


@full_precision
def refine(
    submap: GaussianMap,
    candidates: Gaussians,
    T_world_camera: jaxlie.SE3,
    camera: Camera,
    config: RefinementConfig,
) -> tuple[GaussianMap, Gaussians, RefinementInfo]:
    """Merge candidates with the map where both show the same surface; the others are fresh.

    A candidate on a pixel without map depth is fresh. Otherwise it merges with those of its K_2D closest map Gaussians
    that show the same surface and pass the distance gate, unless it lies in front of or behind the map by more than the
    margin.

    Args:
        submap: the local map, world frame.
        candidates: Gaussians of the points that EM did not fuse.
        T_world_camera: refined pose.
        camera: of the images that are rendered.

    Returns:
        The submap with merged candidates, the candidates with only the fresh ones valid, and counts.
    """
    old = submap.gaussians
    map_splats, candidate_splats = (splats_of(g, T_world_camera, camera, config.render) for g in (old, candidates))
    rendering = render_splats(map_splats, old.colors, camera, config.render)

    map_depth = depth_at(rendering, candidate_splats, camera)
    # Match only visible Gaussians: one behind the rendered surface is occluded.
    own_depth = depth_at(rendering, map_splats, camera)
    reach = config.render.radius * map_splats.depth_std
    visible = map_splats.valid & (own_depth > 0) & (map_splats.depth <= own_depth + reach)
    rows, distance_sq, found = match_on_image(map_splats, candidate_splats, visible, config)
    found &= show_one_surface(old, candidates, map_splats, candidate_splats, rows, config)
    has_depth = map_depth > 0
    on_surface = has_depth & within_margins(candidate_splats.depth, jnp.where(has_depth, map_depth, 1.0), config)
    omega = merge_weights(old, candidates, (rows, distance_sq, found), on_surface, config)

    averaged = average_candidates(candidates, rows, omega, old)
    evidence = jnp.zeros(old.valid.shape[0]).at[rows].max(omega)
    merged, _ = update_average(submap, averaged, evidence, config.average)
    is_merged = jnp.any(omega > 0, axis=-1)
    share = config.feature * omega / jnp.where(is_merged, jnp.sum(omega, axis=-1), 1.0)[:, None]
    said = gathered_features(candidates.features, rows, share, old.valid.shape[0])
    merged = eqx.tree_at(lambda m: m.gaussians.features, merged, merged.gaussians.features + said)
    fresh = eqx.tree_at(lambda g: g.valid, candidates, candidates.valid & ~is_merged)
    info = RefinementInfo(jnp.sum(candidates.valid), jnp.sum(is_merged), jnp.sum(fresh.valid), rendering.overflow)
    return merged, fresh, info
