"""Densification: a point with normal and colour for every pixel of a view, the paper's rule for a sparse map."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.camera import Camera, unproject
from emgs_jax.gaussians import Gaussians
from emgs_jax.linalg import safe_normalize
from emgs_jax.pytree import traced
from emgs_jax.render.composite import RenderConfig, Rendering, render


class DensifyConfig(eqx.Module):
    """Which pixels become points.

    Args:
        opacity: of every Gaussian here. Low, so that a depth is the mean of the layers that noise left in a surface;
            with the refinement's opacity the nearest layer alone would count, which is too near.
        min_alpha: a pixel with less coverage has no depth.
        max_depth_spread: a pixel whose splats differ in depth by more than this fraction mixes two surfaces.
        render: how the map is drawn.
    """

    opacity: Float[Array, "*b"] = traced()
    min_alpha: Float[Array, "*b"] = traced()
    max_depth_spread: Float[Array, "*b"] = traced()
    render: RenderConfig


class DenseView(eqx.Module):
    """Points of one view. World frame; rows of pixels that are not valid hold finite values of no meaning."""

    points: Float[Array, "h w 3"]
    normals: Float[Array, "h w 3"]
    colors: Float[Array, "h w 3"]
    valid: Bool[Array, "h w"]
    rendering: Rendering


def densify(gaussians: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, config: DensifyConfig) -> DenseView:
    """Render depth, normals and colours of the map from one pose and back-project every pixel that has a depth."""
    values = jnp.concatenate([gaussians.colors, gaussians.normals], axis=-1)
    soft = eqx.tree_at(lambda r: (r.opacity, r.min_alpha), config.render, (config.opacity, config.min_alpha))
    rendering = render(gaussians, values, T_world_camera, camera, soft)
    rotation = T_world_camera.rotation().as_matrix()
    points = unproject(camera, rendering.depth) @ rotation.T + T_world_camera.translation()
    alpha = jnp.maximum(rendering.alpha, 1e-6)[..., None]
    valid = (rendering.depth > 0) & (rendering.depth_std <= config.max_depth_spread * rendering.depth)
    return DenseView(
        points=points,
        normals=safe_normalize(rendering.values[..., 3:]),
        colors=rendering.values[..., :3] / alpha,
        valid=valid,
        rendering=rendering,
    )
