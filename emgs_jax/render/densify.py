"""Densification: a point with normal and colour for every pixel of a view, as the paper does for its sparse map."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera, unproject
from emgs_jax.ops.linalg import outer, safe_normalize, tangent_basis
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static_choice, take_rows, traced
from emgs_jax.render.composite import (
    RenderConfig,
    Rendering,
    at_pixels,
    composite,
    images_of,
    light_before,
    lists_of,
    over_chunks,
    rendering_of,
    splat_depth,
    splats_of,
)
from emgs_jax.render.project import Splats
from emgs_jax.render.tiles import Chunks, TileLists


class DensifyConfig(eqx.Module):
    """Which rendered pixels become points of the densified cloud.

    Args:
        surface_depth: fraction of the depth; splats this near to the front belong to one surface.
        min_alpha: a pixel with less coverage has no depth.
        min_std: m; floor of the covariances, which is not drawn along the surface, see `without_floor`.
        points: of the `map` (the paper's rule), or the frames' `own` points that the map does not contradict, see
            `emgs_jax.runs.dense.uncontradicted`.
    """

    min_std: Float[Array, "*b"] = traced(low=0, high=1000)
    render: RenderConfig
    points: str = static_choice("map", "own")
    surface_depth: Float[Array, "*b"] = traced(0.05, low=0)
    min_alpha: Float[Array, "*b"] = traced(0.3, low=0, high=1)

    def in_unit(self, metre: float) -> "DensifyConfig":
        """Return the config with its lengths in a unit in which one of their metres is `metre` long."""
        return self if metre == 1 else eqx.tree_at(lambda config: config.min_std, self, metre * self.min_std)


class DenseView(eqx.Module):
    """Points of one view, world frame; rows of invalid pixels hold arbitrary finite values.

    The point of a `covered` pixel lies about where the map begins, even if the coverage is too low for a depth.
    """

    points: Float[Array, "h w 3"]
    normals: Float[Array, "h w 3"]
    colors: Float[Array, "h w 3"]
    depth: Float[Array, "h w"]  # m, camera-space z of the points; 0 where nothing covers the pixel
    valid: Bool[Array, "h w"]
    covered: Bool[Array, "h w"]  # by any splat
    rendering: Rendering  # of all splats


@full_precision
def densify(gaussians: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, config: DensifyConfig) -> DenseView:
    """Render depth, normals and colours of the map from one pose and back-project every pixel that has a depth.

    The front of a pixel is the weighted median of its splats' depths. Splats within `surface_depth` of it are one
    surface. Its layers are averaged by how near the pixel is to each splat's centre, regardless of their order: the
    nearest layer alone would be too near, and what lies behind must not shine through.
    """
    values = jnp.concatenate([gaussians.colors, gaussians.normals], axis=-1)
    drawn = eqx.tree_at(lambda r: r.min_alpha, config.render, config.min_alpha)

    splats = splats_of(without_floor(gaussians, config.min_std), T_world_camera, camera, drawn)
    lists, pixels = lists_of(splats, camera, drawn)
    whole = composite((splats, values, drawn), lists, pixels, None)
    middle = median_depth(*jax.lax.stop_gradient((splats, lists, pixels, whole[1], drawn)))
    reach = jax.lax.stop_gradient(config.surface_depth) * middle
    surface = composite((splats, values, drawn), lists, pixels, (middle - reach, middle + reach))
    rendering = rendering_of(whole, lists, camera, drawn)
    values_sum, weight, depth_sum, _ = images_of(surface, camera, drawn)
    covered = weight > 0
    weight = jnp.where(covered, weight, 1.0)
    depth = jnp.where(covered, depth_sum / weight, 0.0)
    return DenseView(
        points=unproject(camera, depth) @ T_world_camera.rotation().as_matrix().T + T_world_camera.translation(),
        normals=safe_normalize(values_sum[..., 3:]),
        colors=values_sum[..., :3] / weight[..., None],
        depth=depth,
        valid=(rendering.depth > 0) & covered,
        covered=covered,
        rendering=rendering,
    )


def without_floor(gaussians: Gaussians, min_std: Float[Array, ""]) -> Gaussians:
    """Remove the floor of the covariances along the surface: Σ - min(σ², λ) (I - nn').

    A fit adds the floor σ² = `min_std`² in all directions, so that each covariance can be inverted. If drawn, it makes
    the borders of near things a pixel or two too wide. λ is the smaller variance along the surface, so that a Gaussian
    without this floor stays positive.
    """
    basis = tangent_basis(gaussians.normals)
    along = jnp.einsum("nda,ndc,ncb->nab", basis, gaussians.covs, basis)
    half_difference = 0.5 * (along[:, 0, 0] - along[:, 1, 1])
    smaller = 0.5 * jnp.trace(along, axis1=-2, axis2=-1) - jnp.hypot(half_difference, along[:, 0, 1])
    floor = jnp.minimum(min_std**2, jnp.maximum(smaller, 0.0))
    plane = jnp.eye(3) - outer(gaussians.normals)
    return eqx.tree_at(lambda g: g.covs, gaussians, gaussians.covs - floor[:, None, None] * plane)


def median_depth(
    splats: Splats, lists: TileLists, pixels: Float[Array, "t q 2"], alpha: Float[Array, "t q"], config: RenderConfig
) -> Float[Array, "t q"]:
    """Find every pixel's median depth (m): the first splat behind which at most half of its coverage `alpha` lies."""
    never = lists.rows.shape[0]

    def visit(chunks: Chunks, state: tuple[Int[Array, "t q"], Array]) -> tuple[Int[Array, "t q"], Array]:
        first, log_light = state
        opacity, _ = at_pixels(splats, chunks, pixels, config)
        light, log_light = light_before(opacity, chunks, log_light)
        taken = 1.0 - light * (1.0 - opacity)
        is_past = chunks.exists[..., None] & (taken >= 0.5 * take_rows(alpha, chunks.tiles)[:, None])
        found = jnp.min(jnp.where(is_past, chunks.positions[..., None], never), axis=1)
        return first.at[chunks.tiles].min(found, mode="drop"), log_light

    start = jnp.full(alpha.shape, never), jnp.zeros(alpha.shape)
    first, _ = over_chunks(visit, start, lists, config)
    middle = take_rows(splats, take_rows(lists.rows, first))
    return jnp.where(first < never, splat_depth(middle, pixels[..., None, :], config)[..., 0], 0.0)
