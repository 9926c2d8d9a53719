"""Existence: evidence of later frames for and against a Gaussian, and merging of duplicate surfaces."""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import GaussianMap, without
from emgs_jax.gaussians import blend, has_feature
from emgs_jax.observation import Observation, depth_range
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera
from emgs_jax.ops.linalg import (
    dot,
    inner,
    lower_entries,
    outer,
    quadratic,
    whiten,
    whitened_entries,
    widened_distance_sq,
)
from emgs_jax.ops.neighbours import group_points, nearest, order_of
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, put_rows, static, take_rows, traced, where_rows
from emgs_jax.sight import sight_of, views_through

VIEW = 0.05  # radians between two views, whose errors are not the same
MIN_GAP = 2.0  # standard deviations along the normal; two Gaussians closer than this are one thick sheet


class ExistenceConfig(eqx.Module):
    """Evidence of frames for and against the existence of Gaussians, and merging of duplicate surfaces.

    Args:
        birth: log-odds of a new Gaussian. At 0 it is tentative until it explains points of another frame; above 0, as
            printed, it is confirmed at once.
        hit: log-odds that a frame adds if the Gaussian explains some of its points.
        miss: log-odds that a frame subtracts if it sees through the Gaussian (free-space violation), or if the Gaussian
            explains none of its points.
        max_log_odds: upper limit, so that a bounded number of frames outweighs any number of earlier ones.
        refuted: log-odds below which a Gaussian is removed; `-inf` never, as printed.
        patience: views in a row that clearly see through a Gaussian after which it is removed, however many frames
            saw it before; `inf` never, as printed.
        num_std: k, standard deviations of the depth between a Gaussian and the surface that a frame sees, within which
            it counts as seen.
        min_cos: between its normal and the ray; in a more grazing view it is neither seen nor seen through.
        num_neighbours: nearest seen Gaussians among which a duplicate is searched.
        max_mahalanobis_sq: between two Gaussians that merge, the frame's noise along the normal included; 0 merges
            none, as printed.
        max_layer_sq: likewise if one stands behind the other, see `nearest_layer`.
        min_normal_cos: between their normals.
        feature: of the merged Gaussian: that of the heavier one (`medoid`) or the sum (`accumulated`), see `EmConfig`.
    """

    birth: Float[Array, "*b"] = traced(low=-1e6)
    hit: Float[Array, "*b"] = traced(low=0)
    miss: Float[Array, "*b"] = traced(low=0)
    refuted: Float[Array, "*b"] = traced(low=-math.inf)
    patience: Float[Array, "*b"] = traced(low=1, high=math.inf)
    max_mahalanobis_sq: Float[Array, "*b"] = traced(low=0, high=math.inf)
    max_layer_sq: Float[Array, "*b"] = traced(low=0, high=math.inf)
    feature: Float[Array, "*b"] = choice("medoid", "accumulated")
    max_log_odds: Float[Array, "*b"] = traced(4.0, low=0)
    num_std: Float[Array, "*b"] = traced(3.0, low=0)
    min_cos: Float[Array, "*b"] = traced(0.2, low=-1, high=1)
    num_neighbours: int = static(5, low=1, high=256)
    min_normal_cos: Float[Array, "*b"] = traced(0.9, low=-math.inf, high=1)


class Look(NamedTuple):
    """A frame as evidence for and against Gaussians.

    Args:
        view: its aligned points, world frame; a frame that is not tracked has no valid row.
        T_world_camera: its pose.
        camera: of its rows.
        depth_noise: of its points, as a fraction of their depth.
        T_world_previous: pose of the frame before.
    """

    view: Observation
    T_world_camera: jaxlie.SE3
    camera: Camera
    depth_noise: Float[Array, ""]
    T_world_previous: jaxlie.SE3


class Seen(NamedTuple):
    """An earlier frame, in which later frames have found what moves.

    Args:
        depth: nearest and farthest z (m) around each pixel, 0 where it has none.
        moves: pixels that were taken for static when the frame was mapped, and have moved.
        T_world_camera: its pose, by the latest estimate.
        depth_noise: of its points, as a fraction of their depth.
        time: of the frame; -1 without one.
    """

    depth: Float[Array, "2 p"]
    moves: Bool[Array, "p"]
    T_world_camera: jaxlie.SE3
    depth_noise: Float[Array, ""]
    time: Int[Array, ""]


def fusion_evidence(map: GaussianMap, submap: GaussianMap, rows: Int[Array, "s"]) -> Int[Array, "n"]:
    """Return a frame's evidence for every Gaussian: 1 if it fused points into it, -1 if not, 0 outside the submap.

    Args:
        map: before the frame.
        submap: after it, with its rows in the map.
    """
    use = jnp.where(submap.num_updates > take_rows(map.num_updates, rows), 1, -1)
    return put_rows(jnp.zeros(map.weight.shape, jnp.int32), rows, use)


@full_precision
def update_existence(
    map: GaussianMap,
    use: Int[Array, "n"],
    look: Look,
    config: ExistenceConfig,
) -> tuple[GaussianMap, Bool[Array, "n"]]:
    """Update the existence (log-odds) of every Gaussian by one more frame; refuted Gaussians become free rows.

    Let d be the depths that the frame shows around the Gaussian's pixel, z its own and σ² = (depth_noise · z)² + n'Σn.
    It is seen if |z - min d| <= kσ or |z - max d| <= kσ, and seen through (free-space violation) if z < min d - kσ. A
    Gaussian behind is occluded, and one in between, at an edge, may be either: neither is evidence.

    Unless it is seen through, points that it explains confirm it, however grazing the view and however near an edge.
    There the depth around its pixel shows nothing, and a floor behind a table would never be confirmed. A Gaussian that
    is seen while others explain all points there is redundant, like the second layer of a wall. That is evidence
    against it; otherwise a map would grow as long as a camera looks at it. A confirmed Gaussian counts as redundant
    only if it is as wide as a pixel: a view from afar does not have a point for each.

    So it takes many frames to remove what many have seen. What has changed between two visits goes sooner: `patience`
    views in a row that clearly see through a Gaussian remove it, see `views_through`. As frames from one place err
    alike, a frame is as much of a view as the camera has moved since the one before, seen from the Gaussian: by the
    angle of its turn and that of its shift, up to `VIEW`.

    Args:
        map: all Gaussians, world frame.
        use: evidence of this frame's points, see `fusion_evidence`.
        look: the frame.

    Returns:
        The map, and which Gaussians were seen.
    """
    view, T_world_camera, camera, depth_noise, T_world_previous = look
    gaussians = map.gaussians
    depths = depth_range(view, T_world_camera, camera)
    sight = sight_of(gaussians, depths, T_world_camera, camera, depth_noise, config.num_std, config.min_cos)
    is_seen, is_seen_through = sight.is_seen, sight.is_seen_through

    spread = 0.5 * (jnp.trace(gaussians.covs, axis1=-2, axis2=-1) - sight.variance)  # variance along the surface
    has_points = spread >= (sight.depth / camera.focal[0]) ** 2
    is_superfluous = is_seen & (use < 0) & (has_points | (map.existence <= 0))
    change = config.hit * ((use > 0) & ~is_seen_through) - config.miss * (is_seen_through | is_superfluous)
    existence = jnp.clip(map.existence + change, -config.max_log_odds, config.max_log_odds)
    existence = jnp.where(change == 0, map.existence, existence)

    motion = jax.lax.stop_gradient(T_world_previous.inverse() @ T_world_camera)  # of which views are counted
    turn, shift = (jnp.linalg.norm(part) for part in (motion.rotation().log(), motion.translation()))
    share = jnp.minimum((turn + shift / jnp.maximum(sight.depth, NEAREST_DEPTH)) / VIEW, 1.0)
    # As printed, nothing is counted: the search beside each pixel takes half of the time of an update.
    count, views = partial(views_through, camera=camera), (map.num_through, share, sight, depths[0])
    num_through = jax.lax.cond(config.patience < jnp.inf, count, lambda before, *_: before, *views)
    is_gone = (existence < config.refuted) | (num_through >= config.patience)
    updated = eqx.tree_at(lambda m: (m.existence, m.num_through), map, (existence, num_through))
    return without(updated, is_gone), is_seen


@full_precision
def take_back(map: GaussianMap, seen: Seen, camera: Camera, config: ExistenceConfig) -> GaussianMap:
    """Withdraw an earlier frame's evidence for Gaussians in pixels that are now known to have moved.

    The frame then counts as one that did not explain them: `hit` is withdrawn and `miss` subtracted.

    Args:
        camera: of the frame's rows.
    """
    depths = jnp.where(seen.depth > 0, seen.depth, jnp.nan)
    pose, gates = seen.T_world_camera, (config.num_std, config.min_cos)
    sight = sight_of(map.gaussians, depths, pose, camera, seen.depth_noise, *gates)
    is_wrong = sight.is_seen & seen.moves[sight.index]
    existence = jnp.where(is_wrong, map.existence - config.hit - config.miss, map.existence)
    updated = eqx.tree_at(lambda m: m.existence, map, existence)
    return without(updated, is_wrong & (existence < config.refuted))


@full_precision
def merge_duplicates(
    map: GaussianMap,
    is_seen: Bool[Array, "n"],
    origins: Float[Array, "*#n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> GaussianMap:
    """Merge duplicate surfaces: pairs of Gaussians that a frame cannot tell apart and that are each other's nearest.

    Means, covariances, colours and normals are averaged by the Gaussians' weights. The covariance grows by the spread
    of the means only along the surface: two layers must not make a wall thicker.

    Args:
        is_seen: Gaussians that may merge.
        origins: camera centre of the frame, world frame; one for all Gaussians, or one for each.
        depth_noise: as a fraction of the depth.
    """
    partner, is_pair = nearest_duplicates(map, is_seen, origins, depth_noise, config)
    old, other, rows = map.gaussians, take_rows(map, partner), jnp.arange(partner.shape[0])
    is_heavier = (map.weight > other.weight) | ((map.weight == other.weight) & (rows < partner))
    share = other.weight / jnp.maximum(map.weight + other.weight, jnp.finfo(jnp.float32).tiny)
    mean = blend(old, other.gaussians, share, jnp.zeros(()))
    difference = other.gaussians.means - old.means
    spread = (share * (1.0 - share))[:, None, None] * outer(along_surface(difference, mean.normals))
    features = old.features + config.feature * other.gaussians.features
    joined = GaussianMap(
        gaussians=eqx.tree_at(lambda g: (g.covs, g.features), mean, (mean.covs + spread, features)),
        weight=map.weight + other.weight,
        num_updates=map.num_updates + other.num_updates,
        existence=jnp.maximum(map.existence, other.existence),
        birth=map.birth,
        num_through=map.num_through,
    )
    map = where_rows(is_pair & is_heavier, joined, map)
    return without(map, is_pair & ~is_heavier)


@full_precision
def merge_all_duplicates(
    map: GaussianMap, origins: Float[Array, "n 3"], depth_noise: Float[Array, ""], config: ExistenceConfig
) -> GaussianMap:
    """Merge the duplicates of a whole map after it has moved, until no pair of mutual nearest layers is left.

    When two visits come to lie on each other no frame observes them, so each Gaussian is judged from where it was made.

    Args:
        map: all Gaussians, world frame.
        origins: centre of the camera that made each, world frame.
        depth_noise: as a fraction of the depth.
        config: gates; with `max_mahalanobis_sq` and `max_layer_sq` 0 the map stays as it is.
    """

    def is_left(state: tuple[GaussianMap, Bool[Array, ""]]) -> Bool[Array, ""]:
        return state[1]

    def once(state: tuple[GaussianMap, Bool[Array, ""]]) -> tuple[GaussianMap, Bool[Array, ""]]:
        map, _ = state
        joined = merge_duplicates(map, map.gaussians.valid, origins, depth_noise, config)
        return joined, jnp.any(joined.gaussians.valid != map.gaussians.valid)

    return jax.lax.while_loop(is_left, once, (map, jnp.asarray(True)))[0]


def nearest_duplicates(
    map: GaussianMap,
    is_seen: Bool[Array, "n"],
    origins: Float[Array, "*#n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Find the nearest other layer of every Gaussian, and whether the two are each other's nearest."""
    partner, has_layer = nearest_layer(map, is_seen, is_seen, origins, depth_noise, config)
    return partner, has_layer & has_layer[partner] & (partner[partner] == jnp.arange(partner.shape[0]))


def nearest_layer(
    map: GaussianMap,
    is_asked: Bool[Array, "n"],
    is_known: Bool[Array, "n"],
    origins: Float[Array, "*#n 3"],
    depth_noise: Float[Array, ""],
    config: ExistenceConfig,
) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Find the nearest other layer of every Gaussian in `is_asked` among those in `is_known`, and whether there is one.

    The squared distance of the means is measured with Σ_a + Σ_b + ν²nn', where ν is the frame's noise along the normal
    n of the Gaussian: within it, a frame cannot tell the two apart. If one stands behind the other by more than
    `MIN_GAP` standard deviations of either, they may be two sheets of one surface from different frames, each with its
    own error. Then the distance is measured with ν² (1 / W_a + 1 / W_b), the variance between means of so many frames.
    """
    gaussians, count = map.gaussians, is_asked.shape[0]
    groups = group_points(gaussians.means, is_known)
    order = order_of(group_points(gaussians.means, is_asked), count)
    rows, found = nearest(gaussians.means, is_asked, gaussians.means, groups, config.num_neighbours, order=order)
    noise = depth_noise * jnp.abs(inner(gaussians.normals, gaussians.means - origins))
    covs, normals = lower_entries(gaussians.covs), jnp.unstack(gaussians.normals, axis=-1)
    frames = jnp.maximum(map.weight, 1.0)

    def distance_to(one: tuple[Int[Array, "n"], Bool[Array, "n"]]) -> Float[Array, "n"]:
        """Measure the squared distance to one neighbour of each; infinite if that is no other layer."""
        rows, found = one
        near_covs, near_normals = (tuple(entry[rows] for entry in entries) for entries in (covs, normals))
        offsets = jnp.unstack(gaussians.means[rows] - gaussians.means, axis=-1)
        triangle, _ = whitened_entries(tuple(a + b for a, b in zip(covs, near_covs, strict=True)))
        white, white_normal = whiten(triangle, offsets), whiten(triangle, normals)
        of_means = noise * jnp.sqrt(1.0 / frames + 1.0 / frames[rows])
        distance_sq, of_means_sq = (
            widened_distance_sq(white, tuple(std * entry for entry in white_normal))[0] for std in (noise, of_means)
        )
        thickest = jnp.maximum(quadratic(covs, normals), quadratic(near_covs, normals))
        is_behind = dot(offsets, normals) ** 2 > MIN_GAP**2 * thickest
        is_one = (distance_sq < config.max_mahalanobis_sq) | is_behind & (of_means_sq < config.max_layer_sq)
        is_alike = dot(near_normals, normals) >= config.min_normal_cos
        near_features = gaussians.features[rows]
        has_both = has_feature(near_features) & has_feature(gaussians.features)
        is_alike &= ~has_both | (inner(near_features, gaussians.features) > 0)
        is_layer = found & is_asked & (rows != jnp.arange(count)) & is_one & is_alike
        return jnp.where(is_layer, distance_sq, jnp.inf)

    # In a loop; otherwise XLA computes all of it again for every use of the distances.
    distance_sq = jax.lax.map(distance_to, (rows.T, found.T))
    partner = jnp.take_along_axis(rows, jnp.argmin(distance_sq, axis=0)[:, None], axis=1)[:, 0]
    return partner, jnp.min(distance_sq, axis=0) < jnp.inf


def along_surface(offsets: Float[Array, "*b 3"], normals: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Project each offset onto the plane orthogonal to its normal."""
    return offsets - inner(offsets, normals)[..., None] * normals
