"""Observations: one image's predicted geometry, o^n_t of the paper, and what one call of the prior gives to a step."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced


class Observation(eqx.Module):
    """Points of one image, row by row in the order of its (thinned) pixels.

    Two predictions of the same image correspond row by row. Invalid rows hold finite values of no meaning.
    """

    points: Float[Array, "*b p 3"]  # m; camera or world frame, as the holder says
    colors: Float[Array, "*b p 3"]  # RGB in [0, 1]
    normals: Float[Array, "*b p 3"]  # unit, towards the camera; zero where the row is invalid
    features: Float[Array, "*b p f"]  # unit; f = 0 without features
    confidence: Float[Array, "*b p"]  # >= 1
    valid: Bool[Array, "*b p"]


class Prediction(eqx.Module):
    """One call of the prior, O_t: the current frame, the previous one predicted again, and the window's poses.

    Args:
        current: the frame to integrate, in its own camera frame.
        previous: the frame before it, in its own camera frame; row by row the same pixels as last time.
        T_world_views: the prior's own poses, composed with the anchor; rows: previous, current, newest.
        T_world_anchor: pose of the anchor, about which the scale of this call acts.
        has_newest: False at the end of a sequence, where there is no newer image.
        is_repeat: False where the frame before is of the same call, so that nothing of it is said twice.
    """

    current: Observation
    previous: Observation
    T_world_views: jaxlie.SE3
    T_world_anchor: jaxlie.SE3
    has_newest: Bool[Array, "*b"]
    is_repeat: Bool[Array, "*b"]


class ObservationConfig(eqx.Module):
    """How a point map becomes an observation.

    Args:
        thin: every `thin`-th row and column is kept; 1 = the paper, every pixel.
        normal_radius: normals are fitted over (2·normal_radius + 1)² pixels.
        normal_spacing: of which every `normal_spacing`-th row and column is used.
        max_depth_step: neighbours whose depth differs by more than this fraction lie on another surface.
        min_confidence: points below are left out.
    """

    thin: int = static(low=1, high=64)
    normal_radius: int = static(low=1, high=64)
    normal_spacing: int = static(low=1, high=64)
    max_depth_step: Float[Array, "*b"] = traced(low=0, high=math.inf)
    min_confidence: Float[Array, "*b"] = traced(low=0)


def _shifted(image: Array, dy: int, dx: int, radius: int) -> Array:
    """`image` moved by (dy, dx) with zeros beyond the border."""
    height, width = image.shape[:2]
    padded = jnp.pad(image, [(radius, radius), (radius, radius)] + [(0, 0)] * (image.ndim - 2))
    return padded[radius + dy : radius + dy + height, radius + dx : radius + dx + width]


def normals_from_pointmap(
    points: Float[Array, "h w 3"], valid: Bool[Array, "h w"], config: ObservationConfig
) -> Float[Array, "h w 3"]:
    """Unit normals, towards the camera, of the planes that fit the surroundings of every pixel.

    On a plane n·X = c the inverse depth is linear along the rays d = X / z: 1/z = (n / c)·d. The least-squares fit of
    n / c over the window needs no eigenvectors, and neighbours across a depth step are left out.

    Returns:
        Camera frame; zero where the pixel is invalid or a fifth of the window or less lies on its surface.
    """
    points = jnp.where(valid[..., None], points, 0.0)
    depth = points[..., 2]
    inverse_depth = jnp.where(valid, 1.0 / jnp.where(valid, depth, 1.0), 0.0)
    ray_xy = points[..., :2] * inverse_depth[..., None]
    radius, spacing = config.normal_radius, config.normal_spacing
    taps = [(dy, dx) for dy in range(-radius, radius + 1, spacing) for dx in range(-radius, radius + 1, spacing)]

    count = jnp.zeros_like(depth)
    moments = jnp.zeros((*depth.shape, 3))  # of the ray offsets: xx, xy, yy
    cross = jnp.zeros((*depth.shape, 2))
    sums = jnp.zeros((*depth.shape, 3))  # x, y, 1/z, all relative to the pixel itself
    for dy, dx in taps:
        other = _shifted(inverse_depth, dy, dx, radius)
        weight = ((other > 0) & (jnp.abs(other - inverse_depth) <= config.max_depth_step * inverse_depth)).astype(
            depth.dtype
        )
        x, y = jnp.moveaxis(_shifted(ray_xy, dy, dx, radius) - ray_xy, -1, 0)
        u = other - inverse_depth
        count += weight
        sums += weight[..., None] * jnp.stack([x, y, u], axis=-1)
        moments += weight[..., None] * jnp.stack([x * x, x * y, y * y], axis=-1)
        cross += weight[..., None] * jnp.stack([x * u, y * u], axis=-1)

    mean = sums / jnp.maximum(count, 1.0)[..., None]
    xx = moments[..., 0] - count * mean[..., 0] ** 2
    xy = moments[..., 1] - count * mean[..., 0] * mean[..., 1]
    yy = moments[..., 2] - count * mean[..., 1] ** 2
    xu = cross[..., 0] - count * mean[..., 0] * mean[..., 2]
    yu = cross[..., 1] - count * mean[..., 1] * mean[..., 2]
    det = xx * yy - xy * xy
    # Valid pixels in one line determine no plane; rounding must not decide.
    is_fitted = valid & (count > len(taps) / 5) & (det > 1e-4 * (xx + yy) ** 2)
    safe_det = jnp.where(is_fitted, det, 1.0)
    slope = jnp.stack([yy * xu - xy * yu, xx * yu - xy * xu], axis=-1) / safe_det[..., None]
    level = inverse_depth + mean[..., 2] - jnp.sum(slope * (mean[..., :2] + ray_xy), axis=-1)
    normals = -safe_normalize(jnp.concatenate([slope, level[..., None]], axis=-1))
    return jnp.where(is_fitted[..., None], normals, 0.0)


def sample_features(grid: Float[Array, "y x f"], size: tuple[int, int], thin: int) -> Float[Array, "h w f"]:
    """Features of every `thin`-th row and column of an image, from a grid of cells that together cover the image.

    Pixel u of W lies at ((u + ½) x / W) - ½ among x columns, and rows likewise: bilinear between the cells' centres,
    the border cell's beyond them, unit length again. One cell per pixel is taken as it is.

    Args:
        grid: unit features, zero where there is none.
        size: (height, width) of the image.
        thin: step between the pixels.
    """
    if grid.shape[:2] == size:
        return grid[::thin, ::thin]
    for axis, length in enumerate(size):
        cells = grid.shape[axis]
        at = jnp.clip((jnp.arange(0, length, thin) + 0.5) * (cells / length) - 0.5, 0.0, cells - 1.0)
        low = jnp.floor(at).astype(jnp.int32)
        share = jnp.expand_dims(at - low, [other for other in range(3) if other != axis])
        before, after = (jnp.take(grid, index, axis=axis) for index in (low, jnp.minimum(low + 1, cells - 1)))
        grid = (1.0 - share) * before + share * after
    return safe_normalize(grid)


@full_precision
def known_surface(
    points: Float[Array, "h w 3"], mask: Bool[Array, "h w"], config: ObservationConfig
) -> Bool[Array, "h w"]:
    """Which points of an image `observe` takes: of those in the mask the ones with a normal."""
    valid = mask & (points[..., 2] > 0)
    return valid & _is_surface(normals_from_pointmap(jnp.where(valid[..., None], points, 0.0), valid, config))


def _is_surface(normals: Float[Array, "h w 3"]) -> Bool[Array, "h w"]:
    """A point without a normal lies on a sliver or in a hole's rim, where a prior guesses."""
    return jnp.any(normals != 0, axis=-1)


@full_precision
def observe(
    points: Float[Array, "h w 3"],
    colors: Float[Array, "h w 3"],
    features: Float[Array, "y x f"],
    confidence: Float[Array, "h w"],
    mask: Bool[Array, "h w"],
    config: ObservationConfig,
) -> Observation:
    """Normals from the full point map, then every `thin`-th row and column as rows of an `Observation`.

    `features` is a grid of any resolution that covers the image, see `sample_features`.
    """
    is_finite = jnp.all(jnp.isfinite(points), axis=-1) & (points[..., 2] > 0)
    valid = mask & is_finite & (confidence >= config.min_confidence)
    points = jnp.where(valid[..., None], points, 0.0)
    normals = normals_from_pointmap(points, valid, config)
    valid &= _is_surface(normals)
    confidence = jnp.where(valid, confidence, 1.0)
    thin = config.thin
    points, colors, normals, confidence, valid = (
        image[::thin, ::thin] for image in (points, colors, normals, confidence, valid)
    )
    height, width = mask.shape
    features = sample_features(features, (height, width), thin)
    colors, features = (jnp.where(valid[..., None], image, 0.0) for image in (colors, features))
    image = Observation(points, colors, normals, features, confidence, valid)
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), image)


def depth_in(T_world_camera: jaxlie.SE3, observation: Observation) -> Float[Array, "p"]:
    """Camera-space z (m) of world-frame points."""
    return ((observation.points - T_world_camera.translation()) @ T_world_camera.rotation().as_matrix())[:, 2]


@full_precision
def transform(T_target_source: jaxlie.SE3, observation: Observation, scale: Float[Array, ""]) -> Observation:
    """Scale the points about the source's origin, then move points and normals to the target frame."""
    rotate = T_target_source.rotation().as_matrix().T
    return eqx.tree_at(
        lambda o: (o.points, o.normals),
        observation,
        (scale * observation.points @ rotate + T_target_source.translation(), observation.normals @ rotate),
    )
