"""Depth field: the part of a frame's depth error that is smooth over its image."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.precision import full_precision

NUM_NODES = 5  # along each side of the image
NUM_ROUNDS = 3  # of alternating between weights and field
NUM_INDEPENDENT = 160  # independent errors in an image beside the field, since neighbouring points share theirs
LEAST_SIDE = 1e-6  # of the image, in focal lengths
LEAST_NOISE = 2.0**-22  # of a logarithm of depth: its rounding


class DepthField(eqx.Module):
    """Field f of the logarithm of depth, bilinear between nodes over a part of the image plane; 0 corrects nothing.

    Args:
        nodes: f, indexed by x and y.
        low: (x/z, y/z) of the first node.
        high: of the last one.
    """

    nodes: Float[Array, "*b n n"]
    low: Float[Array, "*b 2"]
    high: Float[Array, "*b 2"]


def depth_errors(
    points: Float[Array, "p 3"],
    means: Float[Array, "p 3"],
    normals: Float[Array, "p 3"],
    center: Float[Array, "3"],
    min_cos: Float[Array, ""] | float,
) -> tuple[Float[Array, "p"], Bool[Array, "p"]]:
    """Compute the log-ratio of each point's depth to that of its Gaussian's plane along the ray, and where it is known.

    ρ = log(n·(x - c) / n·(μ - c)), as in the fine step (R9); 0 where it is unknown.

    Args:
        points: world frame.
        means: of each point's Gaussian.
        center: of the camera.
        min_cos: between normal and ray; a more grazing view does not show where along it the plane lies.
    """
    seen = jnp.sum(normals * (points - center), axis=-1)
    expected = jnp.sum(normals * (means - center), axis=-1)
    is_steep = jnp.abs(seen) >= min_cos * jnp.linalg.norm(points - center, axis=-1)
    is_known = is_steep & (seen * expected > 0)
    return jnp.log(jnp.where(is_known, seen, 1.0) / jnp.where(is_known, expected, 1.0)), is_known


def image_plane(points: Float[Array, "p 3"]) -> Float[Array, "p 2"]:
    """Project camera-frame points to (x/z, y/z); arbitrary behind the camera."""
    return points[:, :2] / jnp.where(points[:, 2:] > 0, points[:, 2:], 1.0)


def node_weights(points: Float[Array, "p 3"], low: Float[Array, "2"], high: Float[Array, "2"]) -> Float[Array, "p n n"]:
    """Compute bilinear weights of the nodes at camera-frame points; constant beyond the outermost nodes."""
    place = (image_plane(points) - low) / jnp.maximum(high - low, LEAST_SIDE)
    place = jnp.clip(place, 0.0, 1.0) * (NUM_NODES - 1)
    along = jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(NUM_NODES)), 0.0)
    return along[:, 0, :, None] * along[:, 1, None, :]


@full_precision
def depth_field(
    points: Float[Array, "p 3"],
    errors: Float[Array, "p"],
    noise: Float[Array, "p"],
    valid: Bool[Array, "p"],
    length: Float[Array, ""],
) -> DepthField:
    """Estimate the field of a frame's depth errors as a Gaussian process on the nodes.

    A network's error is a scale that drifts and a field that is smooth over the image, ρ = B f + noise, with bilinear
    weights B. The precision W of each point is Cauchy's, 1 / (σ² + (ρ - B f)²/4), divided by the number of points that
    share an error:

        f = K (1 + B'WB K)⁻¹ B'W ρ,   K = v exp(-½ |i - j|² / length²)

    v is the variance of the nodes' weighted means in excess of chance. Without similar errors v is 0, and nothing is
    corrected. The caller matches points and map.

    Args:
        points: camera frame.
        errors: ρ, log-ratio of each point's depth to that of the map along its ray.
        noise: σ of each error, including that of the field, which must exceed it clearly.
        valid: which errors are known.
        length: correlation length of the field, as a fraction of the image's side.
    """
    is_before = valid & (points[:, 2] > 0)
    plane = image_plane(points)
    low = jnp.min(plane, axis=0, where=is_before[:, None], initial=jnp.inf)
    high = jnp.max(plane, axis=0, where=is_before[:, None], initial=-jnp.inf)
    has_any = jnp.any(is_before)
    low, high = jnp.where(has_any, low, 0.0), jnp.where(has_any, high, 0.0)

    errors, noise = jnp.where(is_before, errors, 0.0), jnp.where(is_before, jnp.maximum(noise, LEAST_NOISE), 1.0)
    basis = node_weights(points, low, high).reshape(-1, NUM_NODES**2)
    place = jnp.stack(jnp.meshgrid(*[jnp.linspace(0.0, 1.0, NUM_NODES)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    apart = jnp.sum((place - place[:, None]) ** 2, axis=-1)

    alike = jnp.maximum(jnp.sum(is_before) / NUM_INDEPENDENT, 1.0)

    def fit(nodes: Float[Array, "n"], _: None) -> tuple[Float[Array, "n"], None]:
        precision = is_before / (noise**2 + (0.5 * (errors - basis @ nodes)) ** 2) / alike
        weighted = basis * precision[:, None]
        total = jnp.sum(weighted, axis=0)
        is_seen = total > 0
        mean = errors @ weighted / jnp.where(is_seen, total, 1.0)
        share = total / jnp.where(has_any, jnp.sum(total), 1.0)
        chance = jnp.sum(share * is_seen / jnp.where(is_seen, total, 1.0))
        variance = jnp.maximum(jnp.sum(share * mean**2) - chance, 0.0)
        prior = variance * jnp.exp(-0.5 * apart / length**2)
        known = basis.T @ weighted @ prior
        return prior @ jnp.linalg.solve(jnp.eye(NUM_NODES**2) + known, errors @ weighted), None

    nodes, _ = jax.lax.scan(fit, jnp.zeros(NUM_NODES**2), length=NUM_ROUNDS)
    return DepthField(nodes.reshape(NUM_NODES, NUM_NODES), low, high)


def field_at(field: DepthField, points: Float[Array, "p 3"]) -> Float[Array, "p"]:
    """Evaluate f at camera-frame points; 0 behind the camera."""
    weights = node_weights(points, field.low, field.high)
    return jnp.where(points[:, 2] > 0, jnp.einsum("pij,ij->p", weights, field.nodes), 0.0)


@full_precision
def moved_by_field(
    points: Float[Array, "p 3"], field: DepthField, share: Float[Array, ""], T_world_camera: jaxlie.SE3
) -> Float[Array, "p 3"]:
    """Move world-frame points seen between the outermost nodes: x <- x + (x - c) (exp(f share) - 1)."""
    rays = points - T_world_camera.translation()
    seen = rays @ T_world_camera.rotation().as_matrix()
    plane = image_plane(seen)
    is_within = jnp.all((plane >= field.low) & (plane <= field.high), axis=-1)
    return points + rays * jnp.expm1(share * jnp.where(is_within, field_at(field, seen), 0.0))[:, None]
