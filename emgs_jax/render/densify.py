"""Densification: a point with normal and colour for every pixel of a view, the paper's rule for a sparse map."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera, unproject
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.pytree import traced, where_rows
from emgs_jax.render.composite import (
    RenderConfig,
    Rendering,
    Sums,
    blend_weights,
    draw_tiles,
    rendering_of,
    weighted_sums,
)
from emgs_jax.render.project import Splats


class DensifyConfig(eqx.Module):
    """Which pixels become points.

    Args:
        opacity: of every Gaussian here. Low, so that a depth is the mean of the layers that noise left in a surface;
            with the refinement's opacity the nearest layer alone would count, which is too near.
        min_alpha: a pixel with less coverage has no depth.
        max_depth_spread: a pixel whose splats differ in depth by more than this fraction mixes two surfaces. It shows
            the dominant one: the splats within this fraction of the median depth,
        min_layer_share: which must carry at least this share of the pixel's weight.
        render: how the map is drawn.
    """

    opacity: Float[Array, "*b"] = traced()
    min_alpha: Float[Array, "*b"] = traced()
    max_depth_spread: Float[Array, "*b"] = traced()
    min_layer_share: Float[Array, "*b"] = traced()
    render: RenderConfig


class DenseView(eqx.Module):
    """Points of one view. World frame; rows of pixels that are not valid hold finite values of no meaning."""

    points: Float[Array, "h w 3"]
    normals: Float[Array, "h w 3"]
    colors: Float[Array, "h w 3"]
    depth: Float[Array, "h w"]  # m, camera-space z of the points
    valid: Bool[Array, "h w"]
    rendering: Rendering  # of all splats


def densify(gaussians: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, config: DensifyConfig) -> DenseView:
    """Render depth, normals and colours of the map from one pose and back-project every pixel that has a depth."""
    values = jnp.concatenate([gaussians.colors, gaussians.normals], axis=-1)
    soft = eqx.tree_at(lambda r: (r.opacity, r.min_alpha), config.render, (config.opacity, config.min_alpha))

    def blend(splats: Splats, values: Array, pixels: Array, render: RenderConfig) -> tuple[Sums, Sums]:
        weights, depth = blend_weights(splats, pixels, render)
        layer = jnp.where(in_dominant_layer(weights, depth, config.max_depth_spread), weights, 0.0)
        return weighted_sums(weights, depth, values), weighted_sums(layer, depth, values)

    (whole, layer), overflow = draw_tiles(gaussians, values, T_world_camera, camera, soft, blend)
    rendering = rendering_of(*whole, overflow, soft)
    is_mixed = rendering.depth_std > config.max_depth_spread * rendering.depth
    values_sum, weight, depth_sum, _ = where_rows(is_mixed, layer, whole)
    weight = jnp.maximum(weight, 1e-6)
    depth = jnp.where(rendering.depth > 0, depth_sum / weight, 0.0)
    is_dominant = layer[1] >= config.min_layer_share * whole[1]
    return DenseView(
        points=unproject(camera, depth) @ T_world_camera.rotation().as_matrix().T + T_world_camera.translation(),
        normals=safe_normalize(values_sum[..., 3:]),
        colors=values_sum[..., :3] / weight[..., None],
        depth=depth,
        valid=(rendering.depth > 0) & (is_dominant | ~is_mixed),
        rendering=rendering,
    )


def in_dominant_layer(
    weights: Float[Array, "c q"], depth: Float[Array, "c q"], reach: Float[Array, ""]
) -> Bool[Array, "c q"]:
    """Which splats of every pixel, nearest first, lie within a fraction `reach` of their weighted median depth."""
    below = jnp.cumsum(weights, axis=0) < 0.5 * weights.sum(0)
    middle = jnp.take_along_axis(depth, jnp.sum(below, axis=0)[None], axis=0, mode="clip")
    return jnp.abs(depth - middle) <= reach * middle
