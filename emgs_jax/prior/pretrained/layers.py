"""Layers of convolutional networks as functions of (height, width, channels), as their weights were trained.

A volume has its depth before: (depth, height, width, channels).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.pytree import static


class Conv(eqx.Module):
    """A convolution whose result is as large as the image, divided by `stride` or multiplied by `expansion`.

    Args:
        weight: rows, columns, channels of the input (one, where each channel is by itself), channels of the output;
            of volumes with depth before.
        bias: of each channel of the output.
        stride: of the result's pixels on the image, along every axis or each.
        dilation: pixels between those that are weighed.
        expansion: of the image before: the transposed convolution with that stride.
    """

    weight: Float[Array, "*k i o"]
    bias: Float[Array, "o"]
    stride: int | tuple[int, ...] = static()
    dilation: int = static()
    expansion: int | tuple[int, ...] = static()


def convolve(image: Float[Array, "*b i"], conv: Conv) -> Float[Array, "*b2 o"]:
    """Apply a convolution; beyond the image there is zero."""
    axes = conv.weight.ndim - 2
    stride, expansion = (tuple(np.broadcast_to(step, axes).tolist()) for step in (conv.stride, conv.expansion))
    reach = [conv.dilation * (size // 2) for size in conv.weight.shape[:axes]]
    letters = "DHW"[-axes:]
    found = jax.lax.conv_general_dilated(
        image.reshape(-1, *image.shape[-axes - 1 :]),
        conv.weight,
        stride,
        [(r, r + step - 1) for r, step in zip(reach, expansion, strict=True)],
        expansion,
        (conv.dilation,) * axes,
        dimension_numbers=(f"N{letters}C", f"{letters}IO", f"N{letters}C"),
        feature_group_count=image.shape[-1] // conv.weight.shape[-2],
    )
    return found.reshape(*image.shape[: -axes - 1], *found.shape[1:]) + conv.bias


def chain(image: Float[Array, "*b i"], convs: Sequence[Conv]) -> Float[Array, "*b2 o"]:
    """Apply one convolution after the other, with a ReLU between them."""
    for conv in convs[:-1]:
        image = jax.nn.relu(convolve(image, conv))
    return convolve(image, convs[-1])


def resize(image: Float[Array, "h w c"], size: tuple[int, int]) -> Float[Array, "h2 w2 c"]:
    """The image at another (height, width), linearly between pixels and without smoothing; edges lie on edges."""
    return jax.image.resize(image, (*size, image.shape[-1]), "linear", antialias=False)


def sample(
    image: Float[Array, "h w c"], pixels: Float[Array, "*b 2"], is_seen: Bool[Array, "*b"]
) -> Float[Array, "*b c"]:
    """Values linearly between the pixels; zero beyond the image, which falls off within a pixel of its edge.

    Args:
        image: where to look.
        pixels: (x, y); pixel centres are whole numbers.
        is_seen: elsewhere there is zero, too.
    """
    height, width, channels = image.shape
    rows = image.reshape(-1, channels)
    low = jnp.floor(jnp.clip(pixels, -2.0, jnp.asarray([width + 1.0, height + 1.0])))  # whole numbers that fit 32 bits
    share = pixels - low

    def corner(dx: int, dy: int) -> Array:
        x, y = low[..., 0] + dx, low[..., 1] + dy
        weight = jnp.abs(1 - dx - share[..., 0]) * jnp.abs(1 - dy - share[..., 1])
        inside = is_seen & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        index = jnp.where(inside, y * width + x, 0.0).astype(jnp.int32)
        return jnp.where(inside, weight, 0.0)[..., None] * rows[index]

    return corner(0, 0) + corner(1, 0) + corner(0, 1) + corner(1, 1)
