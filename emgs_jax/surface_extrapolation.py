"""Surface extrapolation: new surface continues the depth error of the mapped surface beside it, so that both join."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import traced
from emgs_jax.registration.depth_field import depth_errors

LEAST_POWER = 1e-18  # of errors, squared logarithms of depth; smaller ones are rounding and predict nothing


class ExtrapolationConfig(eqx.Module):
    """Extrapolation of a frame's depth errors from observed surfaces to the new surface beside them.

    Args:
        width: standard deviation of the Gaussian window over which errors are averaged, as a fraction of the image's
            width; 0: new points stay where the frame puts them, as printed.
        max_error: of a logarithm of depth; a larger difference is another surface.
        min_cos: between a Gaussian's normal and the ray; a more grazing view does not show where along it the plane
            lies.
    """

    width: Float[Array, "*b"] = traced(low=0, high=10)
    max_error: Float[Array, "*b"] = traced(0.3, low=0, high=100)
    min_cos: Float[Array, "*b"] = traced(0.3, low=0, high=1)


def depth_error(
    points: Float[Array, "p 3"],
    explained_by: GaussianMap,
    is_fused: Bool[Array, "p"],
    center: Float[Array, "3"],
    config: ExtrapolationConfig,
) -> tuple[Float[Array, "p"], Bool[Array, "p"]]:
    """Compute `depth_errors` of fused points that are no other surface, and which these are; 0 elsewhere."""
    gaussians = explained_by.gaussians
    error, is_known = depth_errors(points, gaussians.means, gaussians.normals, center, config.min_cos)
    is_known &= is_fused & (jnp.abs(error) <= config.max_error)
    return jnp.where(is_known, error, 0.0), is_known


def window(length: int, std: Float[Array, ""]) -> Float[Array, "l l"]:
    """Compute exp(-½ (i - j)² / std²) for all rows (or columns) i, j of an image; the identity if `std` is 0."""
    apart = jnp.arange(length) - jnp.arange(length)[:, None]
    return jnp.where(apart == 0, 1.0, jnp.exp(-0.5 * (apart / jnp.maximum(std, 1e-6)) ** 2))


@full_precision
def extrapolate(
    aligned: Observation,
    explained_by: GaussianMap,
    is_fused: Bool[Array, "p"],
    noise: Float[Array, "p"],
    T_world_camera: jaxlie.SE3,
    camera: Camera,
    config: ExtrapolationConfig,
) -> Observation:
    """Extrapolate depth errors: move points that no Gaussian explains along their rays by their neighbours' error.

    The depth errors of a prediction are similar over much of an image. So points that the map explains predict the
    errors of those beside them. With ρ of `depth_error`, the precision v = (σ_min / σ)² of each point, and the window
    g:

        ρ̂ = b Σ g v ρ W / (W + 1) / (1 + Σ g v),   x <- c + (x - c) exp(-ρ̂)

    W frames made the Gaussian, so its own error has 1 / W of one frame's variance, and only W / (W + 1) of the
    difference is the frame's. b in [0, 1] measures how well neighbours predict a point's error in this frame: the slope
    of ρ over its prediction from all others. If errors are not similar, b is 0 and nothing moves.

    Args:
        aligned: the frame, world frame, one row a pixel of `camera`.
        explained_by: the Gaussian that explains each point best, before this frame, with its weight W.
        noise: of each point, as a fraction of its depth.
        camera: of the rows.
    """
    center = T_world_camera.translation()
    error, is_known = depth_error(aligned.points, explained_by, is_fused, center, config)
    least = jnp.min(noise, where=is_known, initial=jnp.finfo(jnp.float32).max)
    has_noise = is_known & (noise > 0)
    precision = jnp.where(has_noise, jnp.where(has_noise, least, 0.0) / jnp.where(has_noise, noise, 1.0), is_known) ** 2
    std = config.width * camera.width
    down, along = window(camera.height, std), window(camera.width, std)

    def total(values: Float[Array, "p"]) -> Float[Array, "p"]:
        return (down @ values.reshape(camera.height, camera.width) @ along).reshape(-1)

    weighted, near = precision * error, total(precision)
    alone = (total(weighted) - weighted) / (1.0 + near - precision)
    power = jnp.sum(precision * alone**2)
    is_alike = power > LEAST_POWER
    slope = jnp.where(is_alike, jnp.sum(weighted * alone), 0.0) / jnp.where(is_alike, power, 1.0)
    own_share = explained_by.weight / (explained_by.weight + 1.0)
    expected = jnp.clip(slope, 0.0, 1.0) * total(weighted * own_share) / (1.0 + near)
    is_moved = aligned.valid & ~is_fused & (expected != 0)
    moved = center + (aligned.points - center) * jnp.exp(-expected)[:, None]
    return eqx.tree_at(lambda o: o.points, aligned, jnp.where(is_moved[:, None], moved, aligned.points))
