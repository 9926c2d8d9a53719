"""Layers of convolutional networks on (height, width, channels)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.pytree import static


class Conv(eqx.Module):
    """A convolution whose output has the image's size, divided by `stride` or multiplied by `expansion`."""

    weight: Float[Array, "y x i o"]  # i = 1 for a depthwise convolution
    bias: Float[Array, "o"]
    stride: int = static()
    dilation: int = static()
    expansion: int = static()  # 2: a transposed convolution of 3 × 3 weights with stride 2


def convolve(image: Float[Array, "*b i"], conv: Conv) -> Float[Array, "*b2 o"]:
    """Apply a convolution with zero padding."""
    reach = [conv.dilation * (size // 2) for size in conv.weight.shape[:2]]
    found = jax.lax.conv_general_dilated(
        image.reshape(-1, *image.shape[-3:]),
        _of_phases(conv.weight) if conv.expansion == 2 else conv.weight,
        (conv.stride, conv.stride),
        [(r * (conv.expansion == 1), r) for r in reach],
        rhs_dilation=(conv.dilation, conv.dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        feature_group_count=image.shape[-1] // conv.weight.shape[-2],
    )
    if conv.expansion == 2:
        n, height, width, channels = found.shape
        phases = found.reshape(n, height, width, channels // 4, 2, 2).transpose(0, 1, 4, 2, 5, 3)
        found = phases.reshape(n, 2 * height, 2 * width, channels // 4)
    return found.reshape(*image.shape[:-3], *found.shape[1:]) + conv.bias


def _of_phases(weight: Float[Array, "3 3 i o"]) -> Float[Array, "2 2 i p"]:
    """Weights of the 2×2 output pixels of one input pixel in a transposed convolution, without multiplying by zeros.

    Of three weights in a row the first output pixel takes the middle one, the second the first and the last.
    """
    for axis in (0, 1):
        before, at, after = jnp.split(weight, 3, axis)
        pairs = (at, jnp.zeros_like(at)), (before, after)
        weight = jnp.stack([jnp.concatenate(pair, axis) for pair in pairs], axis=-1)
    return weight.reshape(*weight.shape[:3], -1)


def chain(image: Float[Array, "*b i"], convs: Sequence[Conv]) -> Float[Array, "*b2 o"]:
    """Apply convolutions with a ReLU between them."""
    for conv in convs[:-1]:
        image = jax.nn.relu(convolve(image, conv))
    return convolve(image, convs[-1])


def resize(image: Float[Array, "h w c"], size: tuple[int, int]) -> Float[Array, "h2 w2 c"]:
    """Resize to (height, width), bilinear and without antialiasing; edges lie on edges."""
    return jax.image.resize(image, (*size, image.shape[-1]), "linear", antialias=False)


def sample(
    image: Float[Array, "h w c"], pixels: Float[Array, "*b 2"], is_seen: Bool[Array, "*b"]
) -> Float[Array, "*b c"]:
    """Sample bilinearly at pixels (x, y), whose centres are integers; zero beyond the image and unless `is_seen`."""
    height, width, channels = image.shape
    rows = image.reshape(-1, channels)
    low = jnp.floor(jnp.clip(pixels, -2.0, jnp.asarray([width + 1.0, height + 1.0])))  # integers that fit 32 bits
    share = pixels - low

    def corner(dx: int, dy: int) -> Array:
        x, y = low[..., 0] + dx, low[..., 1] + dy
        weight = jnp.abs(1 - dx - share[..., 0]) * jnp.abs(1 - dy - share[..., 1])
        inside = is_seen & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        index = jnp.where(inside, y * width + x, 0.0).astype(jnp.int32)
        return jnp.where(inside, weight, 0.0)[..., None] * rows[index]

    return corner(0, 0) + corner(1, 0) + corner(0, 1) + corner(1, 1)
