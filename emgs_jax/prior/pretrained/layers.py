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
        expansion: of the image before: the transposed convolution with that stride, 2 of three weights.
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
        _of_phases(conv.weight, expansion),
        stride,
        [(r * (step == 1), r) for r, step in zip(reach, expansion, strict=True)],
        rhs_dilation=(conv.dilation,) * axes,
        dimension_numbers=(f"N{letters}C", f"{letters}IO", f"N{letters}C"),
        feature_group_count=image.shape[-1] // conv.weight.shape[-2],
    )
    found = _interleaved(found, expansion)
    return found.reshape(*image.shape[: -axes - 1], *found.shape[1:]) + conv.bias


def _of_phases(weight: Float[Array, "*k i o"], expansion: tuple[int, ...]) -> Float[Array, "*k2 i p"]:
    """Weights of the pixels that come of one where the image is expanded, whose other pixels would all be zero.

    Of three weights in a row, those of a pixel of the image and the next: the middle one and none for the first of the
    two pixels, the first and the last one for the second.
    """
    for axis, step in enumerate(expansion):
        if step == 2:
            before, at, after = jnp.split(weight, 3, axis)
            pairs = (at, jnp.zeros_like(at)), (before, after)
            weight = jnp.stack([jnp.concatenate(pair, axis) for pair in pairs], axis=-1)
    return weight.reshape(*weight.shape[: len(expansion) + 1], -1)


def _interleaved(found: Float[Array, "n *k p"], expansion: tuple[int, ...]) -> Float[Array, "n *k2 o"]:
    """The image of channels in which the pixels of each phase stand."""
    axes, phases = len(expansion), [step for step in expansion if step > 1]
    found = found.reshape(*found.shape[:-1], -1, *phases)
    for axis, step in enumerate(expansion):
        if step > 1:
            found = jnp.moveaxis(found, axes + 2, axis + 2)
            size = found.shape
            found = found.reshape(*size[: axis + 1], step * size[axis + 1], *size[axis + 3 :])
    return found


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
