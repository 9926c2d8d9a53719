"""Observations: one image's predicted geometry, o^n_t of the paper, and what one call of the prior gives to a step."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.linalg import ROUNDED_CORRELATION, safe_normalize
from emgs_jax.ops.neighbours import is_within_reach
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static, traced, where_rows

ROUNDED_SQUARE = 2.0**-19  # by which rounding may change a unit quaternion's squared length


class Observation(eqx.Module):
    """Points of one image, row by row in the order of its (thinned) pixels.

    Two predictions of the same image correspond row by row. Invalid rows hold arbitrary finite values.
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
        pose_covariance: of ξ, if the true pose is T Exp(ξ): translation (unit of the prediction), rotation (rad). Rows:
            motion from the previous frame, own pose. NaN if the prior states no uncertainty.
        scale_std: of the logarithm of the factor between the lengths of the current frame's points and of its pose. NaN
            if the prior states no uncertainty.
        has_newest: False at the end of a sequence, where there is no newer image.
        is_repeat: False if the previous frame comes from the same call, so that nothing was predicted twice.
    """

    current: Observation
    previous: Observation
    T_world_views: jaxlie.SE3
    T_world_anchor: jaxlie.SE3
    pose_covariance: Float[Array, "*b 2 6 6"]
    scale_std: Float[Array, "*b"]
    has_newest: Bool[Array, "*b"]
    is_repeat: Bool[Array, "*b"]


def no_covariance() -> Float[Array, "2 6 6"]:
    """Make `Prediction.pose_covariance` of a prior that states no uncertainty."""
    return jnp.full((2, 6, 6), jnp.nan, jnp.float32)  # not of a weak type, which is another program


def unknown_scale() -> Float[Array, ""]:
    """Make `Prediction.scale_std` of a prior that states no uncertainty."""
    return jnp.asarray(jnp.nan, jnp.float32)


class ObservationConfig(eqx.Module):
    """Conversion of a point map into an observation: thinning, normals and masking.

    Args:
        thin: every `thin`-th row and column is kept; 1 = every pixel, as in the paper.
        normal_radius: normals are fitted over (2·normal_radius + 1)² pixels.
        normal_spacing: step between the rows and columns of that window that are used.
        max_depth_step: neighbours whose depth differs by more than this fraction lie on another surface.
        min_confidence: points below are left out.
    """

    thin: int = static(low=1, high=64)
    normal_radius: int = static(4, low=1, high=64)
    normal_spacing: int = static(2, low=1, high=64)
    max_depth_step: Float[Array, "*b"] = traced(0.05, low=0, high=math.inf)
    min_confidence: Float[Array, "*b"] = traced(1.0, low=0)


def normals_from_pointmap(
    points: Float[Array, "h w 3"], valid: Bool[Array, "h w"], config: ObservationConfig
) -> Float[Array, "h w 3"]:
    """Fit a plane to the surroundings of every pixel and return its unit normal, towards the camera.

    On a plane n·X = c the inverse depth is linear along the rays d = X / z: 1/z = (n / c)·d. The least-squares fit of
    n / c over the window needs no eigenvectors. Neighbours across a depth step are left out.

    Returns:
        Normals, camera frame; zero if the pixel is invalid or at most a fifth of the window lies on its surface.
    """
    points = jnp.where(valid[..., None], points, 0.0)
    depth = points[..., 2]
    inverse_depth = jnp.where(valid, 1.0 / jnp.where(valid, depth, 1.0), 0.0)
    ray_xy = points[..., :2] * inverse_depth[..., None]
    radius, spacing = config.normal_radius, config.normal_spacing
    steps = jnp.arange(0, 2 * radius + 1, spacing)
    taps = jnp.stack(jnp.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    border = [(radius, radius), (radius, radius)]
    around = jnp.pad(inverse_depth, border), jnp.pad(ray_xy, [*border, (0, 0)])

    def add(moments: tuple[Array, ...], tap: Int[Array, "2"]) -> tuple[tuple[Array, ...], None]:
        """Add one neighbour of every pixel: its count, offsets x, y, u = 1/z from the pixel, and their products."""
        other, ray = (jax.lax.dynamic_slice(x, (*tap, 0)[: x.ndim], (*depth.shape, 2)[: x.ndim]) for x in around)
        is_same = (other > 0) & (jnp.abs(other - inverse_depth) <= config.max_depth_step * inverse_depth)
        (x, y), u = jnp.unstack(ray - ray_xy, axis=-1), other - inverse_depth
        terms = jnp.ones_like(u), x, y, u, x * x, x * y, y * y, x * u, y * u
        return tuple(sum + jnp.where(is_same, term, 0.0) for sum, term in zip(moments, terms, strict=True)), None

    # A loop: unrolled, these few lines took a tenth of all compilation.
    sums, _ = jax.lax.scan(add, (jnp.zeros_like(depth),) * 9, taps)
    count, xx, xy, yy, xu, yu = sums[0], *sums[4:]
    x, y, u = (total / jnp.maximum(count, 1.0) for total in sums[1:4])
    xx, xy, yy = xx - count * x**2, xy - count * x * y, yy - count * y**2
    xu, yu = xu - count * x * u, yu - count * y * u
    det = xx * yy - xy * xy
    # Valid pixels in one line determine no plane; do not let rounding decide.
    is_fitted = valid & (count > taps.shape[0] / 5) & (det > 1e-4 * (xx + yy) ** 2)
    safe_det = jnp.where(is_fitted, det, 1.0)
    slope = jnp.stack([yy * xu - xy * yu, xx * yu - xy * xu], axis=-1) / safe_det[..., None]
    level = inverse_depth + u - jnp.sum(slope * (jnp.stack([x, y], axis=-1) + ray_xy), axis=-1)
    normals = -safe_normalize(jnp.concatenate([slope, level[..., None]], axis=-1))
    return jnp.where(is_fitted[..., None], normals, 0.0)


def sample_features(grid: Float[Array, "y x f"], size: tuple[int, int], thin: int) -> Float[Array, "h w f"]:
    """Sample the features of every `thin`-th row and column of an image from a grid of cells that covers it.

    Pixel u of W lies at ((u + ½) x / W) - ½ among x columns, and rows likewise: bilinear between the cells' centres,
    constant beyond them, then normalised. A grid with one cell per pixel is used as it is.

    Args:
        grid: unit features, zero where there is none.
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


def sound(observation: Observation) -> Observation:
    """Invalidate rows with a number that is not finite or a point beyond any map, and set them to 0.

    Colours are clipped to [0, 1].
    """
    o = observation
    is_sound = is_within_reach(o.points) & jnp.isfinite(o.confidence)
    for vectors in (o.colors, o.normals, o.features):
        is_sound &= jnp.all(jnp.isfinite(vectors), axis=-1)
    o = where_rows(is_sound, o, jax.tree.map(jnp.zeros_like, o))
    confidence = jnp.where(is_sound, o.confidence, 1.0)
    return eqx.tree_at(lambda o: (o.colors, o.confidence), o, (jnp.clip(o.colors, 0.0, 1.0), confidence))


def sound_poses(poses: jaxlie.SE3) -> jaxlie.SE3:
    """Set poses to NaN that lie beyond any map or whose quaternion is not a rotation's.

    A quaternion that is off unit length by more than rounding is normalised: products of poses rely on unit length, and
    over many frames the lengths multiply.
    """
    quaternion, translation = poses.wxyz_xyz[..., :4], poses.wxyz_xyz[..., 4:]
    length_sq = jnp.sum(quaternion**2, axis=-1)
    off = jnp.abs(length_sq - 1.0)
    is_sound = (off < 0.1) & is_within_reach(translation)
    length = jnp.sqrt(jnp.where(is_sound & (off > ROUNDED_SQUARE), length_sq, 1.0))
    values = jnp.concatenate([quaternion / length[..., None], translation], axis=-1)
    return jaxlie.SE3(jnp.where(is_sound[..., None], values, jnp.nan))


def sound_covariances(covariances: Float[Array, "*b 6 6"]) -> Float[Array, "*b 6 6"]:
    """Set covariances to NaN that have a negative variance or an impossible correlation."""
    variances = jnp.diagonal(covariances, axis1=-2, axis2=-1)
    std = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    correlations = covariances / std[..., None] / std[..., None, :]
    roots = jnp.linalg.cholesky(correlations + ROUNDED_CORRELATION * jnp.eye(6))
    return jnp.where(jnp.all(jnp.isfinite(roots), axis=(-2, -1), keepdims=True), covariances, jnp.nan)


@full_precision
def known_surface(
    points: Float[Array, "h w 3"], mask: Bool[Array, "h w"], config: ObservationConfig
) -> Bool[Array, "h w"]:
    """Return the mask of the points that `observe` keeps: inside `mask`, in front of the camera and with a normal."""
    valid = mask & is_within_reach(points) & (points[..., 2] > 0)
    return valid & _is_surface(normals_from_pointmap(jnp.where(valid[..., None], points, 0.0), valid, config))


def _is_surface(normals: Float[Array, "h w 3"]) -> Bool[Array, "h w"]:
    """Tell which points have a normal; the others lie on slivers or rims of holes, where a prior guesses."""
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
    """Compute normals from the full point map, then take every `thin`-th row and column as rows of an `Observation`.

    Points that are not finite, behind the camera or beyond any map are left out. `features` is a grid of any resolution
    that covers the image, see `sample_features`; a feature that is not finite counts as missing.
    """
    is_sound = is_within_reach(points) & (points[..., 2] > 0) & jnp.all(jnp.isfinite(colors), axis=-1)
    valid = mask & is_sound & jnp.isfinite(confidence) & (confidence >= config.min_confidence)
    features = jnp.where(jnp.all(jnp.isfinite(features), axis=-1, keepdims=True), features, 0.0)
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


@full_precision
def depth_in(T_world_camera: jaxlie.SE3, observation: Observation) -> Float[Array, "p"]:
    """Compute the camera-space z (m) of world-frame points."""
    return ((observation.points - T_world_camera.translation()) @ T_world_camera.rotation().as_matrix())[:, 2]


def depth_range(view: Observation, T_world_camera: jaxlie.SE3, camera: Camera) -> Float[Array, "2 p"]:
    """Find the nearest and farthest depth z (m) among each pixel and its eight neighbours; NaN if the pixel has none.

    This way, a pose that is off by a pixel does not see through a thin pole.
    """
    depth = depth_in(T_world_camera, view).reshape(camera.height, camera.width)
    valid = view.valid.reshape(depth.shape)

    def least(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
        return jax.lax.reduce_window(jnp.where(valid, depth, jnp.inf), jnp.inf, jax.lax.min, (3, 3), (1, 1), "SAME")

    return jnp.where(valid, jnp.stack([least(depth), -least(-depth)]), jnp.nan).reshape(2, -1)


@full_precision
def transform(T_target_source: jaxlie.SE3, observation: Observation, scale: Float[Array, ""]) -> Observation:
    """Scale the points about the source's origin, then move points and normals to the target frame."""
    rotate = T_target_source.rotation().as_matrix().T
    return eqx.tree_at(
        lambda o: (o.points, o.normals),
        observation,
        (scale * observation.points @ rotate + T_target_source.translation(), observation.normals @ rotate),
    )
