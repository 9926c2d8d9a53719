"""Matching: which Gaussian of a surface explains each point, for given poses."""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import GaussianIndex, Gaussians, color_gradients, index_of, intensity
from emgs_jax.observation import Observation
from emgs_jax.ops.linalg import dot, gather_entries, gather_offsets, mahalanobis_sq, whiten, widen
from emgs_jax.ops.neighbours import Groups

LEAST_VARIANCE = 1e-30  # m²; no Gaussian is so thin, and float32 divides by its root
Candidates: TypeAlias = tuple[Int[Array, "p k"], Bool[Array, "p k"]]  # of `nearest`: rows of the Gaussians, which exist


class Surface(eqx.Module):
    """Gaussians with everything that is computed once for all comparisons.

    Args:
        gaussians: n of them, world frame.
        groups: of the means of the valid ones, see `group_points`.
        triangles: of `whitening`.
        plane_vars: m²; variance along the normal.
        light: luminance.
        gradients: 1/m; of the luminance in the tangent plane.
    """

    gaussians: Gaussians
    groups: Groups
    triangles: Float[Array, "n 6"]
    plane_vars: Float[Array, "n"]
    light: Float[Array, "n"]
    gradients: Float[Array, "n 3"]


class Matches(eqx.Module):
    """The Gaussian of every point, the point's whitened noise, and whether the two agree.

    `plane_std` (m) includes the point's noise, `plane_vars` (m²) does not.
    """

    means: Float[Array, "p 3"]
    normals: Float[Array, "p 3"]
    triangle: Float[Array, "p 6"]
    noise: Float[Array, "p 3"]
    plane_vars: Float[Array, "p"]
    plane_std: Float[Array, "p"]
    light: Float[Array, "p"]
    gradients: Float[Array, "p 3"]
    is_inlier: Bool[Array, "p"]


def surface_of(
    gaussians: Gaussians,
    has_color: Bool[Array, ""],
    num_color_neighbours: int,
    index: GaussianIndex | None = None,
) -> Surface:
    """Compute index (if None), thickness and colour gradients (zero unless `has_color`)."""
    index = index_of(gaussians) if index is None else index
    # Only if colour is used: the gradients cost a neighbour search over the submap.
    gradients = jax.lax.cond(
        has_color,
        lambda: color_gradients(gaussians, num_color_neighbours, index.groups),
        lambda: jnp.zeros_like(gaussians.means),
    )
    return Surface(
        gaussians=gaussians,
        groups=index.groups,
        triangles=index.white[0],
        plane_vars=mahalanobis_sq(gaussians.normals, gaussians.covs),  # n' Σ n
        light=intensity(gaussians.colors),
        gradients=gradients,
    )


def match(
    points: Observation,
    noise: Float[Array, "p 3"],
    candidates: Candidates,
    surface: Surface,
    gates: tuple[Float[Array, ""], Float[Array, ""]],
) -> Matches:
    """Match each point to the nearest of its candidates in Mahalanobis distance.

    Args:
        points: p of them, world frame.
        noise: m; standard deviation of every point along its viewing ray, as a vector.
        gates: largest squared Mahalanobis distance and smallest cosine between the normals of an inlier.
    """
    (rows, found), gaussians = candidates, surface.gaussians
    offsets, triangles = gather_offsets(points.points, gaussians.means, rows), gather_entries(surface.triangles, rows)
    white = widen(whiten(triangles, offsets), whiten(triangles, jnp.unstack(noise[:, None], axis=-1)))
    distance_sq = jnp.where(found, dot(white, white), jnp.inf)
    best = jnp.argmin(distance_sq, axis=-1)[:, None]
    row = jnp.take_along_axis(rows, best, axis=1)[:, 0]
    normals, triangle = gaussians.normals[row], surface.triangles[row]
    plane_var = surface.plane_vars[row] + jnp.sum(normals * noise, axis=-1) ** 2
    white_noise = whiten(jnp.unstack(triangle, axis=-1), jnp.unstack(noise, axis=-1))
    max_mahalanobis_sq, min_normal_cos = gates
    is_near = jnp.min(distance_sq, axis=-1) <= max_mahalanobis_sq
    is_alike = jnp.sum(normals * points.normals, axis=-1) >= min_normal_cos
    return Matches(
        means=gaussians.means[row],
        normals=normals,
        triangle=triangle,
        noise=jnp.stack(white_noise, axis=-1),
        plane_vars=surface.plane_vars[row],
        plane_std=jnp.sqrt(jnp.maximum(plane_var, LEAST_VARIANCE)),
        light=surface.light[row],
        gradients=surface.gradients[row],
        is_inlier=points.valid & is_near & is_alike,
    )
