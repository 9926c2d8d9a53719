"""The map M: Gaussians in arrays of fixed capacity with the weights of their running averages, and its submaps."""

import math
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians, blend, empty_gaussians
from emgs_jax.observation import Observation
from emgs_jax.ops.neighbours import compact_rows
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import choice, put_rows, static, take_rows, traced, where_rows


class GaussianMap(eqx.Module):
    """Gaussians and, for each, the state of its running average.

    Args:
        gaussians: world frame.
        weight: what eq. 4 keeps per Gaussian: α_{t-1} for the printed gain, the accumulated support for `count` (R4).
        num_updates: how often EM or refinement fused something into it, at most twice a frame.
        existence: log-odds that its surface exists. Above 0 it is confirmed; otherwise it is tentative: frames are
            fused into it, but not aligned against it, and it is not exported.
        birth: `SlamState.time` of the frame that made it. It moves with that frame, because later frames were
            registered to it.
        num_through: views in a row that clearly saw through it; -1 while its surface drifts, see `update_existence`.
    """

    gaussians: Gaussians
    weight: Float[Array, "*b n"]
    num_updates: Int[Array, "*b n"]
    existence: Float[Array, "*b n"]
    birth: Int[Array, "*b n"]
    num_through: Float[Array, "*b n"]


class AverageConfig(eqx.Module):
    """Average over frames in the update of a Gaussian (eq. 4 and 6).

    Args:
        gain: `ema_printed`, α_t = δ / (α_{t-1} + δ), an exponential average; or `count`, W += δ, α = δ / W, which tends
            to the mean of all frames (R4; West 1979).
        forgetting: factor on the kept α or W before each update; 1 = the printed form.
        max_weight: upper limit of the kept α or W, so that a still camera does not make the map certain: errors that
            its predictions share do not average out. `inf` as printed.
        blend: of covariances: `linear` (printed) or `moment_matched` (R13).
    """

    gain: Float[Array, "*b"] = choice("ema_printed", "count")
    forgetting: Float[Array, "*b"] = traced(low=0, high=1)
    max_weight: Float[Array, "*b"] = traced(low=1, high=math.inf)
    blend: Float[Array, "*b"] = choice("linear", "moment_matched")


class SubmapConfig(eqx.Module):
    """Settings of the submap, the part of the map that a step works on, and initial capacities.

    Args:
        voxel_size: m; Gaussians are looked up by the voxel of their mean.
        margin: m; added around the box of the previous cloud.
        map_capacity: initial rows of the map; doubled when it is full.
        submap_capacity: initial rows of a submap; likewise.
    """

    voxel_size: Float[Array, "*b"] = traced(0.1, low=1e-6, high=1000)
    margin: Float[Array, "*b"] = traced(0.1, low=0, high=1000)
    map_capacity: int = static(32768, low=1, high=2**26)
    submap_capacity: int = static(8192, low=1, high=2**26)


def empty_map(capacity: int, num_features: int) -> GaussianMap:
    """Make a map without Gaussians."""
    nothing, none = jnp.zeros(capacity), jnp.zeros(capacity, jnp.int32)
    return GaussianMap(empty_gaussians(capacity, num_features), nothing, none, nothing, none, nothing)


def new_map(
    gaussians: Gaussians, weight: Float[Array, "n"], existence: Float[Array, ""], birth: Int[Array, ""]
) -> GaussianMap:
    """Make a map of new Gaussians, all with the same log-odds of existence and from the same frame."""
    num_updates = jnp.ones(weight.shape, jnp.int32)
    existence, birth = (jnp.broadcast_to(value, weight.shape) for value in (existence, birth))
    return GaussianMap(gaussians, weight, num_updates, existence, birth, jnp.zeros(weight.shape))


def confirmed(map: GaussianMap) -> Gaussians:
    """Return the Gaussians, of which only the confirmed ones are valid."""
    return eqx.tree_at(lambda g: g.valid, map.gaussians, map.gaussians.valid & (map.existence > 0))


@full_precision
def transform_rows(
    map: GaussianMap,
    means: Float[Array, "n 3"],
    turn: Float[Array, "*#n 3 3"],
    scale: Float[Array, "*#n"],
    min_std: Float[Array, ""] | float = 0.0,
) -> GaussianMap:
    """Apply a similarity, common or one for each Gaussian: Σ' = s² R (Σ - min_std² I) Rᵀ + min_std² I.

    Args:
        means: the transformed means, world frame.
        turn: R.
        scale: s.
        min_std: m; floor of the covariances that does not scale with the scene, as in deformed maps; else 0.

    Raises:
        KeyError: a field of the map has no rule here.
    """

    def shapes(covs: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
        floor = min_std**2 * jnp.eye(3)
        turned = jnp.einsum("...ij,...jk,...lk->...il", turn, covs - floor, turn)
        return scale[..., None, None] ** 2 * (0.5 * (turned + turned.mT)) + floor  # symmetric despite rounding

    def same(values: Array) -> Array:
        return values

    rules = {
        "means": lambda _: means,
        "covs": shapes,
        "normals": lambda normals: jnp.einsum("...ij,...j->...i", turn, normals),
        **dict.fromkeys(
            ("colors", "features", "valid", "weight", "num_updates", "existence", "birth", "num_through"), same
        ),
    }

    def moved(part: Any) -> Any:
        return type(part)(**{field.name: rules[field.name](getattr(part, field.name)) for field in fields(part)})

    rules["gaussians"] = moved
    return moved(map)


@full_precision
def transformed(map: GaussianMap, scale: ArrayLike, rotation: ArrayLike, translation: ArrayLike) -> GaussianMap:
    """Apply one similarity y = s R x + t to a whole map; free rows stay neutral."""
    s, R, t = (jnp.asarray(value, jnp.float32) for value in (scale, rotation, translation))
    means = s * jnp.einsum("ij,nj->ni", R, map.gaussians.means) + t
    return where_rows(map.gaussians.valid, transform_rows(map, means, R, s), map)


def without(map: GaussianMap, is_gone: Bool[Array, "n"]) -> GaussianMap:
    """Return the map with some rows freed."""
    return where_rows(is_gone, empty_map(is_gone.shape[0], map.gaussians.features.shape[-1]), map)


def update_average(
    map: GaussianMap, new: Gaussians, evidence: Float[Array, "n"], config: AverageConfig
) -> tuple[GaussianMap, Float[Array, "n"]]:
    """Average (1 - α) M + α M_new with the gain α = δ / (min(forgetting · w, max_weight) + δ) of each Gaussian (eq. 4).

    Args:
        new: parameters from this frame, row by row.
        evidence: δ >= 0; with 0 a Gaussian stays the same, bit for bit.

    Returns:
        The map and the gain.
    """
    kept = jnp.minimum(config.forgetting * map.weight, config.max_weight) + evidence
    has_evidence = (evidence > 0) & map.gaussians.valid
    gain = jnp.where(has_evidence, evidence / jnp.where(has_evidence, kept, 1.0), 0.0)
    weight = jnp.where(has_evidence, jnp.where(config.gain > 0, kept, gain), map.weight)
    blended = where_rows(has_evidence, blend(map.gaussians, new, gain, config.blend), map.gaussians)
    return replace(map, gaussians=blended, weight=weight, num_updates=map.num_updates + has_evidence), gain


def select_submap(
    map: GaussianMap, clouds: tuple[Observation, ...], config: SubmapConfig
) -> tuple[GaussianMap, Int[Array, "s"], Int[Array, ""]]:
    """Select the Gaussians whose voxel lies in the bounding box of the valid points of `clouds` (world frame).

    The paper uses the box of the previous frame's cloud. With wide baselines that misses what only the current frame
    sees, so the step passes both, the current one at its coarse pose.

    Returns:
        The submap, its rows in the map (the map's capacity for empty ones), and how many Gaussians did not fit.
    """
    points = jnp.concatenate([cloud.points for cloud in clouds])
    valid = jnp.concatenate([cloud.valid for cloud in clouds])[:, None]
    low = jnp.min(jnp.where(valid, points, jnp.inf), axis=0) - config.margin
    high = jnp.max(jnp.where(valid, points, -jnp.inf), axis=0) + config.margin
    voxels, low, high = (jnp.floor(x / config.voxel_size) for x in (map.gaussians.means, low, high))
    is_inside = jnp.all((voxels >= low) & (voxels <= high), axis=-1) & map.gaussians.valid
    rows, exists, overflow = compact_rows(is_inside, config.submap_capacity)
    submap = take_rows(map, rows)
    return eqx.tree_at(lambda m: m.gaussians.valid, submap, exists), rows, overflow


def write_back(map: GaussianMap, submap: GaussianMap, rows: Int[Array, "s"]) -> GaussianMap:
    """Write the rows of a submap back into its map."""
    return put_rows(map, rows, submap)


def insert(map: GaussianMap, new: GaussianMap) -> tuple[GaussianMap, Int[Array, ""], Int[Array, ""]]:
    """Write the valid rows of `new` into free rows of the map.

    Returns:
        The map, how many were inserted, and how many found no free row.
    """
    num_new, num_rows = new.weight.shape[0], map.weight.shape[0]
    sources, exists, _ = compact_rows(new.gaussians.valid, num_new)
    free, is_free, _ = compact_rows(~map.gaussians.valid, min(num_new, num_rows))
    free = jnp.pad(free, (0, num_new - free.shape[0]), constant_values=num_rows)
    is_free = jnp.pad(is_free, (0, num_new - is_free.shape[0]))
    targets = jnp.where(exists & is_free, free, num_rows)
    overflow = jnp.sum(exists & ~is_free)
    return put_rows(map, targets, take_rows(new, sources)), jnp.sum(exists & is_free), overflow


def grow(map: GaussianMap, capacity: int) -> GaussianMap:
    """Grow a map, or a stack of maps, to `capacity` rows (on the host: the shape changes)."""
    stacked = map.weight.shape[:-1]
    free = empty_map(capacity - map.weight.shape[-1], map.gaussians.features.shape[-1])

    def append(rows: Array, more: Array) -> Array:
        return jnp.concatenate([rows, jnp.broadcast_to(more, (*stacked, *more.shape))], axis=len(stacked))

    return jax.tree.map(append, map, free)
