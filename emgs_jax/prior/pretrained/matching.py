"""What networks for multi-view stereo have in common: features of all views, matched at points, and recurrent units."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.pretrained.layers import Conv, convolve, sample
from emgs_jax.prior.sources import Sources

FINEST, MIDDLE, COARSEST = 2, 4, 8  # pixels of the image to one of the features


class Features(NamedTuple):
    """Of one image, at 1/2, 1/4 and 1/8 of its size."""

    finest: Float[Array, "*b h2 w2 c2"]
    middle: Float[Array, "*b h4 w4 c4"]
    coarsest: Float[Array, "*b h8 w8 c8"]


def pyramid(
    scales: Sequence[Array], lateral: Sequence[Conv], out: Sequence[Conv], double: Callable[[Array], Array]
) -> Features:
    """Features of what is at a half, a quarter and an eighth of the size, with what the coarser ones say."""
    half, quarter, eighth = scales
    middle = double(eighth) + convolve(quarter, lateral[0])
    finest = double(middle) + convolve(half, lateral[1])
    return Features(*(convolve(image, last) for image, last in zip((finest, middle, eighth), out, strict=True)))


def inverse_between(unit: Array, depth_range: Float[Array, "2"]) -> Array:
    """0 (farthest) to 1 (nearest) -> 1/z."""
    near, far = 1.0 / depth_range[0], 1.0 / depth_range[1]
    return far + unit * (near - far)


def seen_from(points: Float[Array, "*b 3"], source: Sources) -> Float[Array, "*b 3"]:
    """Points of the reference camera in that of a source."""
    return points @ source.T_source_view.rotation().as_matrix().T + source.T_source_view.translation()


def correlation(
    reference: Float[Array, "h w c"],
    source: Float[Array, "h2 w2 c"],
    points: Float[Array, "n h w 3"],
    camera: Camera,
    num_groups: int,
) -> Float[Array, "n h w g"]:
    """Mean product of the channels of each group, where the source shows the points; zero where it does not.

    Args:
        reference: features of the pixels whose points they are.
        source: features of the other view.
        points: in its camera.
        camera: of its features.
    """
    is_ahead = points[..., 2] > 0
    pixels = camera.focal * points[..., :2] / jnp.where(is_ahead, points[..., 2], 1.0)[..., None] + camera.center
    product = sample(source, pixels, is_ahead) * reference
    return jnp.mean(product.reshape(*product.shape[:-1], num_groups, -1), axis=-1)


def upsample(values: Float[Array, "h w"], logits: Float[Array, "h w k"], beyond: str) -> Float[Array, "h2 w2"]:
    """Each of r×r pixels is a convex combination of nine values around it (Teed and Deng, ECCV 2020).

    Args:
        values: one for each block of r×r pixels.
        logits: of the combinations, k = 9 r².
        beyond: what lies outside, a mode of `jnp.pad`.
    """
    (height, width), ratio = values.shape, math.isqrt(logits.shape[-1] // 9)
    padded = jnp.pad(values, 1, mode=beyond)
    around = jnp.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=-1)
    weights = jax.nn.softmax(logits.reshape(height, width, 9, ratio, ratio), axis=2)
    return jnp.einsum("hwk,hwkyx->hywx", around, weights).reshape(ratio * height, ratio * width)


def turn(hidden: Float[Array, "h w c"], seen: Float[Array, "h w i"], gates: Sequence[Conv]) -> Float[Array, "h w c"]:
    """One step of a convolutional gated recurrent unit: the update's gate, the reset's, and the candidate."""
    both = jnp.concatenate([hidden, seen], axis=-1)
    update, reset = (jax.nn.sigmoid(convolve(both, gate)) for gate in gates[:2])
    candidate = jnp.tanh(convolve(jnp.concatenate([reset * hidden, seen], axis=-1), gates[2]))
    return (1.0 - update) * hidden + update * candidate
