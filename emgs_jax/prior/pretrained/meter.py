"""METER-XXS: depth of a single image by convolutions and a little attention.

Papa, Russo and Amerini, "METER: a mobile vision transformer architecture for monocular depth estimation", IEEE TCSVT
2023. The image is halved five times by inverted bottlenecks (Sandler et al., CVPR 2018); at the last three sizes each
pixel of a 2×2 patch also attends to the same pixel of all other patches (Mehta and Rastegari, ICLR 2022); what comes of
it is doubled three times, with what was there on the way down beside it.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.precision import full_precision
from emgs_jax.prior.pretrained.layers import Conv, chain, convolve
from emgs_jax.prior.pretrained.weights import NORM_EPSILON, Tensors, conv

SOURCE = "https://github.com/lorenzopapa5/METER (MIT), models/build_model_best_nyu_xxs"
PATCH, HEAD_SIZE = 2, 8  # pixels of a patch's side, channels of an attention's head; as the weights were trained


class Linear(eqx.Module):
    """A matrix, or of a normalisation its diagonal, and an offset."""

    weight: Float[Array, "*i o"]
    bias: Float[Array, "o"]


class Attention(eqx.Module):
    """A layer of a transformer: attention, and two matrices with a ReLU between; before each, a normalisation."""

    norms: tuple[Linear, ...]
    queries_keys_values: Linear
    mixed: Linear
    feed: tuple[Linear, ...]


class PatchBlock(eqx.Module):
    """Convolutions, attention between patches, and convolutions of that beside the input."""

    before: tuple[Conv, ...]
    attention: Attention
    after: tuple[Conv, ...]


class Meter(eqx.Module):
    """Weights of the whole network; a bottleneck is three convolutions."""

    first: tuple[Conv, ...]
    down: tuple[tuple[Conv, ...] | PatchBlock, ...]
    bottom: tuple[Conv, ...]
    up: tuple[tuple[Conv, ...], ...]
    out: Conv


def _in_turn(image: Float[Array, "h w i"], convs: Sequence[Conv]) -> Float[Array, "h2 w2 o"]:
    for each in convs:
        image = convolve(image, each)
    return image


def _times(values: Float[Array, "*b i"], linear: Linear) -> Float[Array, "*b o"]:
    return values @ linear.weight + linear.bias


def _normalised(values: Float[Array, "*b c"], norm: Linear) -> Float[Array, "*b c"]:
    return jax.nn.standardize(values, axis=-1, epsilon=NORM_EPSILON) * norm.weight + norm.bias


def _attend(tokens: Float[Array, "p n c"], layer: Attention) -> Float[Array, "p n c"]:
    """Each token looks at the others of its row."""
    found = _times(_normalised(tokens, layer.norms[0]), layer.queries_keys_values)
    query, key, value = jnp.moveaxis(found.reshape(*found.shape[:2], 3, -1, HEAD_SIZE), 2, 0)
    seen = jax.nn.dot_product_attention(query, key, value)
    tokens = tokens + _times(seen.reshape(*tokens.shape[:2], -1), layer.mixed)
    fed = jax.nn.relu(_times(_normalised(tokens, layer.norms[1]), layer.feed[0]))
    return tokens + _times(fed, layer.feed[1])


def _between_patches(image: Float[Array, "h w c"], block: PatchBlock) -> Float[Array, "h w c"]:
    *local, widened = block.before
    found = jax.nn.relu(convolve(jax.nn.relu(_in_turn(image, local)), widened))
    rows, columns, channels = found.shape[0] // PATCH, found.shape[1] // PATCH, found.shape[2]
    split = found.reshape(rows, PATCH, columns, PATCH, channels).transpose(1, 3, 0, 2, 4)
    tokens = _attend(split.reshape(PATCH**2, rows * columns, channels), block.attention)
    joined = tokens.reshape(split.shape).transpose(2, 0, 3, 1, 4).reshape(found.shape)
    narrowed, *local = block.after
    beside = jnp.concatenate([jax.nn.relu(convolve(joined, narrowed)), image], axis=-1)
    return jax.nn.relu(_in_turn(beside, local))


@full_precision
def predict(network: Meter, image: Float[Array, "h w 3"]) -> Float[Array, "h4 w4"]:
    """Depth up to a factor, at a quarter of the size, of an RGB image in [0, 1].

    Height and width are multiples of 64; it was trained at 192 and 256.
    """
    image = jax.nn.relu(_in_turn(jax.nn.standardize(image, axis=None), network.first))
    kept = []
    for block in network.down:
        if isinstance(block, PatchBlock):
            image = _between_patches(image, block)
            continue
        found = chain(image, block)
        image = image + found if found.shape == image.shape else found
        if block[1].stride > 1:
            kept.append(image)
    image = _in_turn(jax.nn.relu(_in_turn(image, network.bottom[:1])), network.bottom[1:])
    for (doubling, *local), beside in zip(network.up, kept[2::-1], strict=True):
        image = jax.nn.relu(_in_turn(jnp.concatenate([convolve(image, doubling), beside], axis=-1), local))
    return convolve(image, network.out)[..., 0]


def build_network(tensors: Tensors) -> Meter:
    """The network of tensors that are named as in the published file; KeyError names one that is missing."""
    part, encoder, decoder = tensors, "encoder", "decoder"
    halving = (1, 4, 5, 6)
    narrow = [_bottleneck(part, f"{encoder}.mv2.{n}.conv", 2 if n in halving else 1) for n in range(7)]
    patches = [_patch_block(part, f"{encoder}.mvit.{n}") for n in range(3)]
    ups = tuple(
        (
            conv(part, f"{decoder}.ups_block_{n}.conv2d_transpose", expansion=2),
            conv(part, f"{decoder}.ups_block_{n}.end_up_layer.0.depthwise"),
            conv(part, f"{decoder}.ups_block_{n}.end_up_layer.0.pointwise"),
        )
        for n in (1, 2, 3)
    )
    return Meter(
        first=_separable(part, f"{encoder}.conv1", 2),
        down=(*narrow[:5], patches[0], narrow[5], patches[1], narrow[6], patches[2]),
        bottom=(conv(part, f"{encoder}.conv2.0", f"{encoder}.conv2.1"), conv(part, f"{decoder}.conv2d_in")),
        up=ups,
        out=conv(part, f"{decoder}.conv2d_out"),
    )


def _separable(part: Tensors, name: str, stride: int = 1) -> tuple[Conv, ...]:
    return conv(part, f"{name}.0.depthwise", stride=stride), conv(part, f"{name}.0.pointwise", f"{name}.1")


def _bottleneck(part: Tensors, name: str, stride: int) -> tuple[Conv, ...]:
    return tuple(conv(part, f"{name}.{n}", f"{name}.{n + 1}", stride if n == 3 else 1) for n in (0, 3, 6))


def _linear(part: Tensors, name: str) -> Linear:
    weight = part[f"{name}.weight"].T
    return Linear(jnp.asarray(weight), jnp.asarray(part.get(f"{name}.bias", np.zeros(weight.shape[-1], np.float32))))


def _patch_block(part: Tensors, name: str) -> PatchBlock:
    first, second = (f"{name}.transformer.layers.0.{n}" for n in (0, 1))
    attention = Attention(
        tuple(_linear(part, f"{layer}.norm") for layer in (first, second)),
        *(_linear(part, f"{first}.fn.{which}") for which in ("to_qkv", "to_out.0")),
        tuple(_linear(part, f"{second}.fn.net.{n}") for n in (0, 3)),
    )
    before = (*_separable(part, f"{name}.conv1"), conv(part, f"{name}.conv2.0", f"{name}.conv2.1"))
    after = (conv(part, f"{name}.conv3.0", f"{name}.conv3.1"), *_separable(part, f"{name}.conv4"))
    return PatchBlock(before, attention, after)
