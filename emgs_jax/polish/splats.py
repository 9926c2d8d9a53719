"""Flat splats on the map's surface, their fitted parameters, and the loss."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import traced
from emgs_jax.render.composite import RenderConfig, Rendering, render_splats, splats_of

FLATNESS = 0.1  # initial thickness of a splat as a share of its smaller width


class Anchors(eqx.Module):
    """Initial places of splats, which are not fitted.

    Args:
        means: m, world.
        axes: columns are the two directions along the surface, and the normal.
        std: m, along the first two.
        noise: m; how far a mean may leave the surface: the map's standard deviation along the normal.
    """

    means: Float[Array, "n 3"]
    axes: Float[Array, "n 3 3"]
    std: Float[Array, "n 2"]
    noise: Float[Array, "n"]


class Appearance(eqx.Module):
    """Fitted parameters of every splat.

    Args:
        colors: RGB.
        logit: of the opacity.
        log_std: logarithm of the factor on the anchor's widths.
        turn: rotation vector (rad) of the anchor's axes, in those axes.
        shift: argument of the shift along the normal, `noise` · tanh(shift).
    """

    colors: Float[Array, "n 3"]
    logit: Float[Array, "n"]
    log_std: Float[Array, "n 2"]
    turn: Float[Array, "n 3"]
    shift: Float[Array, "n"]


class Shot(NamedTuple):
    """An image with its pose and exposure.

    Args:
        target: RGB of the image and the map's depth (m); pixels of depth 0 count in no term.
        T_world_camera: its pose.
        gain: factor for each channel from the splats' colours to the image's.
    """

    target: Float[Array, "h w 4"]
    T_world_camera: jaxlie.SE3
    gain: Float[Array, "3"]


# As 3DGS draws; the capacity of tiles is doubled when it is too small.
AS_3DGS = {"tile_size": 8, "tile_capacity": 192, "tile_batch": 1024, "opacity": 1.0}


class LossConfig(eqx.Module):
    """Weights of the loss, and rendering of splats.

    Args:
        dssim: share of D-SSIM in the photometric term; the rest is L1 (Kerbl et al. 2023: .2).
        depth: weight of the relative difference to the map's depth.
        normal: weight of 1 - cos between normals of splats and of the map.
        render: rendering; its opacity is that of a splat with opacity 1.
    """

    dssim: Float[Array, "*b"] = traced(0.2, low=0, high=1)
    depth: Float[Array, "*b"] = traced(0.5, low=0)
    normal: Float[Array, "*b"] = traced(0.1, low=0)
    render: RenderConfig = eqx.field(default_factory=partial(RenderConfig, **AS_3DGS))


def initial(colors: Float[Array, "n 3"], opacity: Float[Array, ""]) -> Appearance:
    """Make splats equal to their anchors, in these colours."""
    count = colors.shape[0]
    logit = jnp.full(count, jnp.log(opacity / (1.0 - opacity)))
    return Appearance(colors, logit, jnp.zeros((count, 2)), jnp.zeros((count, 3)), jnp.zeros(count))


@full_precision
def gaussians_of(anchors: Anchors, fitted: Appearance) -> tuple[Gaussians, Float[Array, "n"]]:
    """Convert splats to flat Gaussians in the world, without features, and opacities in (0, 1)."""
    axes = anchors.axes @ jaxlie.SO3.exp(fitted.turn).as_matrix()
    thickness = FLATNESS * jnp.min(anchors.std, axis=-1, keepdims=True)
    std = jnp.concatenate([anchors.std * jnp.exp(fitted.log_std), thickness], axis=-1)
    scaled = axes * std[:, None]
    means = anchors.means + (anchors.noise * jnp.tanh(fitted.shift))[:, None] * anchors.axes[..., 2]
    count = means.shape[0]
    covs, features = jnp.einsum("nik,njk->nij", scaled, scaled), jnp.zeros((count, 0))
    gaussians = Gaussians(means, covs, fitted.colors, axes[..., 2], features, jnp.ones(count, bool))
    return gaussians, jax.nn.sigmoid(fitted.logit)


@full_precision
def draw(
    gaussians: Gaussians, opacity: Float[Array, "n"], T: jaxlie.SE3, camera: Camera, config: RenderConfig
) -> Rendering:
    """Render Gaussians with an opacity each, over black, from T_world_camera."""
    splats = splats_of(gaussians, T, camera, config)
    splats = eqx.tree_at(lambda s: s.opacity, splats, opacity)
    return render_splats(splats, gaussians.colors, camera, config)


class Misfit(NamedTuple):
    """Errors measured by `loss`.

    Args:
        mean_sq: squared error of the colours.
        gain: with which the splats' picture would be as bright as the image.
        overflow: splats that did not fit into the tiles' lists.
    """

    mean_sq: Float[Array, ""]
    gain: Float[Array, "3"]
    overflow: Int[Array, ""]


@full_precision
def loss(
    fitted: Appearance, anchors: Anchors, shot: Shot, camera: Camera, c: LossConfig
) -> tuple[Float[Array, ""], Misfit]:
    """Compute the photometric loss of 3DGS plus terms of the map's depth and normals."""
    gaussians, opacity = gaussians_of(anchors, fitted)
    drawn = draw(gaussians, opacity, shot.T_world_camera, camera, c.render)
    image, depth = shot.target[..., :3], shot.target[..., 3]
    is_seen = depth > 0
    count = jnp.maximum(jnp.sum(is_seen), 1)
    found = jnp.where(is_seen[..., None], shot.gain * drawn.values, image)
    photometric = (1.0 - c.dssim) * jnp.sum(jnp.abs(found - image)) / (3 * count)
    photometric += c.dssim * 0.5 * (1.0 - ssim(found, image))
    has_both = is_seen & (drawn.depth > 0)
    off = jnp.where(has_both, jnp.abs(drawn.depth - depth) / jnp.where(is_seen, depth, 1.0), 0.0)
    tilt = 1.0 - jnp.sum(gaussians.normals * anchors.axes[..., 2], axis=-1)
    total = photometric + c.depth * jnp.sum(off) / count + c.normal * jnp.mean(tilt)
    gain = relative_gain(drawn.values, image, is_seen)
    return total, Misfit(jnp.sum((found - image) ** 2) / (3 * count), gain, drawn.overflow)


def relative_gain(
    picture: Float[Array, "h w 3"], image: Float[Array, "h w 3"], is_seen: Bool[Array, "h w"]
) -> Float[Array, "3"]:
    """Compute the ratio of the channels' means over visible pixels; 1 if everything is black.

    A regression would be biased: lower the more the picture is blurred or displaced.
    """
    of_image, of_picture = (jnp.sum(jnp.where(is_seen[..., None], x, 0.0), axis=(0, 1)) for x in (image, picture))
    is_lit = (of_image > 0) & (of_picture > 0)
    return jnp.where(is_lit, of_image / jnp.where(is_lit, of_picture, 1.0), 1.0)


@full_precision
def ssim(a: Float[Array, "h w c"], b: Float[Array, "h w c"]) -> Float[Array, ""]:
    """Compute mean structural similarity: window of 11 pixels, σ = 1.5, zero outside (Wang et al. 2004; as 3DGS)."""
    rows, columns = (_window(side) for side in a.shape[:2])
    planes = jnp.concatenate([a, b, a * a, b * b, a * b], axis=-1)
    blurred = jnp.einsum("yi,xj,ijc->yxc", rows, columns, planes)
    mean_a, mean_b, aa, bb, ab = jnp.split(blurred, 5, axis=-1)
    luminance = (2.0 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    variances = (aa - mean_a**2) + (bb - mean_b**2)
    return jnp.mean(luminance * (2.0 * (ab - mean_a * mean_b) + 0.03**2) / (variances + 0.03**2))


def _window(side: int) -> Float[Array, "s s"]:
    """Make the blur along one axis as a matrix: two products replace a convolution."""
    offsets = jnp.arange(side)[:, None] - jnp.arange(side)
    weights = jnp.exp(-0.5 * jnp.arange(-5.0, 6.0) ** 2 / 1.5**2)
    return jnp.where(jnp.abs(offsets) <= 5, jnp.exp(-0.5 * offsets**2 / 1.5**2) / jnp.sum(weights), 0.0)
