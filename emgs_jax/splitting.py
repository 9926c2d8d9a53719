"""Splitting: a Gaussian that is seen from nearer than when it was made, and contradicts its points, becomes two."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation
from emgs_jax.ops.linalg import outer, principal_axes_2x2, tangent_basis
from emgs_jax.ops.neighbours import compact_rows
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import put_rows, static, take_rows, traced


class SplittingConfig(eqx.Module):
    """When to split a Gaussian.

    Args:
        max_splits: in one frame; 0: none, as printed.
        min_points: of one frame, in units of those that make a new Gaussian; 4 is a surface at half the distance.
        color_std: RGB; a larger deviation of the points from the Gaussian's colour contradicts it.
        min_normal_cos: so does a smaller mean cosine between their normals and its own,
        num_std: and a spread across the surface of more standard deviations of their noise.
        min_std: m; floor of the covariances; a Gaussian that is hardly wider is not split.
    """

    max_splits: int = static(low=0, high=2**20)
    min_std: Float[Array, "*b"] = traced(low=0, high=1000)
    min_points: Float[Array, "*b"] = traced(4.0, low=0)
    color_std: Float[Array, "*b"] = traced(0.1, low=0, high=math.inf)
    min_normal_cos: Float[Array, "*b"] = traced(0.9, low=-math.inf, high=1)
    num_std: Float[Array, "*b"] = traced(2.0, low=0, high=math.inf)


def is_too_coarse(
    gaussians: Gaussians,
    points: Observation,
    noise: Float[Array, "m 3"],
    owners: Int[Array, "m"],
    spacing: int,
    config: SplittingConfig,
) -> Bool[Array, "n"]:
    """Find Gaussians with more points than one needs, if these points contradict its colour, normal or plane.

    Args:
        gaussians: n of them, world frame.
        points: m of them, world frame.
        noise: of each point along its viewing ray, a vector, m.
        owners: the Gaussian that explains each point best; n for none.
        spacing: points that make a new Gaussian.
    """
    own = take_rows(gaussians, owners)
    height = jnp.sum((points.points - own.means) * own.normals, axis=-1)
    terms = (
        jnp.ones_like(height),
        jnp.mean((points.colors - own.colors) ** 2, axis=-1),
        jnp.sum(points.normals * own.normals, axis=-1),
        height,
        height**2,
        jnp.sum(noise * own.normals, axis=-1) ** 2,
    )
    sums = jnp.zeros((gaussians.valid.shape[0], len(terms))).at[owners].add(jnp.stack(terms, axis=-1), mode="drop")
    count, *totals = jnp.unstack(sums, axis=-1)
    color, normal_cos, height, height_sq, noise_sq = (total / jnp.maximum(count, 1.0) for total in totals)
    is_contradicted = (color > config.color_std**2) | (normal_cos < config.min_normal_cos)
    is_contradicted |= height_sq - height**2 > config.num_std**2 * (noise_sq + config.min_std**2)
    return gaussians.valid & (count >= config.min_points * spacing) & is_contradicted


def halves(map: GaussianMap, min_std: Float[Array, ""]) -> tuple[GaussianMap, GaussianMap, Float[Array, "n"]]:
    """Cut every Gaussian through its mean, across its longer tangential axis e.

    The halves of N(μ, S) have means μ ± √(2/π) s and the covariance S - 2/π s s', for s = S e / √(e' S e): together
    they have its mean and covariance. S is Σ without the floor min_std² I, which both halves keep. Each gets half of
    the weight; colour, normal, feature and existence stay.

    Returns:
        Both halves, and e' S e.
    """
    gaussians = map.gaussians
    basis = tangent_basis(gaussians.normals)
    shape = gaussians.covs - min_std**2 * jnp.eye(3)
    axes = principal_axes_2x2(jnp.einsum("nda,ndc,ncb->nab", basis, shape, basis))[..., 0]
    axes = jnp.einsum("nda,na->nd", basis, axes)
    along = jnp.einsum("nij,nj->ni", shape, axes)
    variance = jnp.sum(along * axes, axis=-1)
    step = along / jnp.sqrt(jnp.where(variance > jnp.finfo(jnp.float32).tiny, variance, 1.0))[:, None]
    covs = gaussians.covs - 2 / jnp.pi * outer(step)

    def half(sign: float) -> GaussianMap:
        means = gaussians.means + sign * (2 / jnp.pi) ** 0.5 * step
        changed = (means, covs, 0.5 * map.weight)
        return eqx.tree_at(lambda m: (m.gaussians.means, m.gaussians.covs, m.weight), map, changed)

    return half(-1.0), half(1.0), variance


@full_precision
def split(
    map: GaussianMap,
    points: Observation,
    noise: Float[Array, "m 3"],
    owners: Int[Array, "m"],
    spacing: int,
    config: SplittingConfig,
) -> tuple[GaussianMap, GaussianMap]:
    """Replace Gaussians that are too coarse by one of their halves.

    Arguments as in `is_too_coarse`.

    Returns:
        The map, and `max_splits` rows with the other halves.
    """
    is_coarse = is_too_coarse(map.gaussians, points, noise, owners, spacing, config)
    rows, exists, _ = compact_rows(is_coarse, config.max_splits)
    first, second, variance = halves(take_rows(map, rows), config.min_std)
    exists &= variance >= config.min_std**2
    second = eqx.tree_at(lambda m: m.gaussians.valid, second, exists)
    return put_rows(map, jnp.where(exists, rows, is_coarse.shape[0]), first), second
