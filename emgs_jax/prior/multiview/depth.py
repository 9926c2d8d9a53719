"""Dense depth of one view from several others, with holes where the images do not determine it."""

import math
from dataclasses import field

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera, nearest_pixel, project, unproject
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced
from emgs_jax.prior.multiview.plane_sweep import SweepConfig, inverse_depths, smallest, sweep
from emgs_jax.prior.multiview.semi_global import SemiGlobalConfig, aggregate
from emgs_jax.prior.sources import Sources


class DepthConfig(eqx.Module):
    """Matching, and which depths are accepted."""

    sweep: SweepConfig = field(default_factory=SweepConfig)
    semi_global: SemiGlobalConfig = field(default_factory=SemiGlobalConfig)
    max_cost: Float[Array, "*b"] = traced(0.4, low=0, high=math.inf)  # of the best plane, before aggregation
    min_margin: Float[Array, "*b"] = traced(0.0, low=0)  # aggregated cost of a distant plane above the best's
    temperature: Float[Array, "*b"] = traced(0.05, low=1e-6)  # cost above the best's at which plausibility is 1/e
    median_radius: int = static(2, low=0, high=32)  # of the median filter, which removes speckle


def _between_planes(total: Float[Array, "h w d"], best: Array) -> Float[Array, "h w"]:
    """Offset of the minimum from `best`, in planes, by the parabola through three costs."""
    last = total.shape[-1] - 1
    before, at, after = (
        jnp.take_along_axis(total, jnp.clip(best + step, 0, last)[..., None], axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    curvature = before - 2.0 * at + after
    is_bent = curvature > 0
    offset = 0.5 * (before - after) / jnp.where(is_bent, curvature, 1.0)
    return jnp.where(is_bent, jnp.clip(offset, -0.5, 0.5), 0.0)


def _spread(total: Float[Array, "h w d"], best: Array, temperature: Float[Array, ""]) -> Float[Array, "h w"]:
    """RMS distance of the plausible planes from the best, in planes."""
    plausible = jax.nn.softmax(-total / temperature, axis=-1)
    distance = jnp.arange(total.shape[-1]) - best[..., None]
    return jnp.sqrt(jnp.sum(plausible * distance**2, axis=-1))


def _median(depth: Float[Array, "h w"], radius: int) -> Float[Array, "h w"]:
    """Median filter; a hole (0) stays one unless most of its surroundings are surface."""
    height, width = depth.shape
    padded = jnp.pad(depth, radius, mode="edge")
    steps = range(2 * radius + 1)
    around = [jax.lax.dynamic_slice(padded, (dy, dx), (height, width)) for dy in steps for dx in steps]
    return smallest(jnp.stack(around), len(around) // 2 + 1)[-1]


@full_precision
def estimate_depth(
    gray: Float[Array, "h w"], sources: Sources, depth_range: Float[Array, "2"], camera: Camera, config: DepthConfig
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Depth z (m) of every pixel, 0 where no plane stands out or the best is the first or last; and its spread.

    The spread is the RMS distance of plausible planes from the best, in planes, which are steps of 1/z. Images are in
    [0, 1]; `depth_range` is the nearest and the farthest depth to try.
    """
    planes = inverse_depths(depth_range[0], depth_range[1], config.sweep)
    cost = sweep(gray, sources, planes, camera, config.sweep)
    total = aggregate(cost, gray, config.semi_global)
    best = jnp.argmin(total, axis=-1)
    is_near_best = jnp.abs(jnp.arange(planes.shape[0]) - best[..., None]) <= 1
    runner_up = jnp.min(jnp.where(is_near_best, jnp.inf, total), axis=-1)
    matched = jnp.take_along_axis(cost, best[..., None], axis=-1)[..., 0]
    valid = (runner_up - jnp.min(total, axis=-1) >= config.min_margin) & (matched <= config.max_cost)
    valid &= (best > 0) & (best < planes.shape[0] - 1)
    inverse = planes[0] + (best + _between_planes(total, best)) * (planes[1] - planes[0])
    depth = _median(jnp.where(valid, 1.0 / inverse, 0.0), config.median_radius)
    return depth, _spread(total, best, config.temperature)


@full_precision
def mean_difference(
    depth: Float[Array, "h w"], others: Sources, camera: Camera, depth_step: Float[Array, ""]
) -> Float[Array, "h w"]:
    """Relative difference of other depth maps from each depth, -δ₀ log mean exp(-d / δ₀); inf where none has a depth.

    δ₀ is `depth_step`: a view that differs by much more, or shows nothing there, just does not confirm. Depths are 0
    where there is none.
    """
    points = unproject(camera, depth)

    def agrees(T: Array, other: Array) -> Array:
        T = jaxlie.SE3(T)
        pixels, seen_depth = project(camera, points @ T.rotation().as_matrix().T + T.translation())
        index, inside = nearest_pixel(pixels, other.shape)
        there = other.reshape(-1)[index]
        is_seen = inside & (depth > 0) & (there > 0)
        difference = jnp.abs(seen_depth / jnp.where(is_seen, there, 1.0) - 1.0)
        return jnp.where(is_seen, jnp.exp(-difference / depth_step), 0.0)

    agreed = jax.vmap(agrees)(others.T_source_view.wxyz_xyz, others.views)
    agreed = jnp.mean(agreed, axis=0, where=others.is_used[:, None, None])
    return jnp.where(agreed > 0, -depth_step * jnp.log(jnp.where(agreed > 0, agreed, 1.0)), jnp.inf)


@full_precision
def pixels_per_log_depth(depth: Float[Array, "h w"], sources: Sources, camera: Camera) -> Float[Array, "h w"]:
    """Motion of each point in a source, in pixels per unit of log z, in the source where it moves most.

    0 where no source shows the point, its ray goes through the sources' centres, or the depth is 0.
    """
    points = unproject(camera, depth)

    def moves(T: Array, used: Array) -> Array:
        T = jaxlie.SE3(T)
        turned = points @ T.rotation().as_matrix().T

        def shown(log_scale: Array) -> tuple[Array, Array]:
            return project(camera, jnp.exp(log_scale) * turned + T.translation())

        (pixels, seen_depth), (speed, _) = jax.jvp(shown, (jnp.zeros(()),), (jnp.ones(()),))
        is_shown = used & (depth > 0) & (seen_depth > 0) & nearest_pixel(pixels, depth.shape)[1]
        return jnp.where(is_shown, jnp.linalg.norm(speed, axis=-1), 0.0)

    return jnp.max(jax.vmap(moves)(sources.T_source_view.wxyz_xyz, sources.is_used), axis=0)
