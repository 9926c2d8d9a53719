"""METER-XXS: monocular depth by convolutions and a little attention.

Papa, Russo and Amerini, "METER: a mobile vision transformer architecture for monocular depth estimation", IEEE TCSVT
2023. Inverted bottlenecks (Sandler et al., CVPR 2018) halve the image five times; at the last three sizes each pixel of
a 2×2 patch attends to the same pixel of all other patches (Mehta and Rastegari, ICLR 2022). A decoder with skip
connections doubles the result three times.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.ops.precision import full_precision
from emgs_jax.prior.pretrained.layers import Conv, chain, convolve
from emgs_jax.prior.pretrained.weights import NORM_EPSILON, Tensors, layers, read_layers

SOURCE = "https://github.com/lorenzopapa5/METER (MIT), models/build_model_best_nyu_xxs"
PATCH, HEAD_SIZE = 2, 8  # side of a patch, channels of an attention head
HALVING, FIRST_PATCHES = (1, 4, 5, 6), 4  # bottlenecks that halve, and the first with attention after it
SEPARABLE = ("0.depthwise", "0.pointwise")


class Linear(eqx.Module):
    """A linear layer, or the diagonal one of a normalisation."""

    weight: Float[Array, "*i o"]
    bias: Float[Array, "o"]


Layers = Mapping[str, Any]  # convolutions and matrices, by their names in the published file


def _in_turn(image: Float[Array, "h w i"], convs: Sequence[Conv]) -> Float[Array, "h2 w2 o"]:
    for each in convs:
        image = convolve(image, each)
    return image


def _times(values: Float[Array, "*b i"], linear: Linear) -> Float[Array, "*b o"]:
    return values @ linear.weight + linear.bias


def _normalised(values: Float[Array, "*b c"], norm: Linear) -> Float[Array, "*b c"]:
    return jax.nn.standardize(values, axis=-1, epsilon=NORM_EPSILON) * norm.weight + norm.bias


def _attend(tokens: Float[Array, "p n c"], network: Layers, name: str) -> Float[Array, "p n c"]:
    """A transformer layer: each token attends to the others of its row."""
    found = _times(_normalised(tokens, network[f"{name}.0.norm"]), network[f"{name}.0.fn.to_qkv"])
    query, key, value = jnp.moveaxis(found.reshape(*found.shape[:2], 3, -1, HEAD_SIZE), 2, 0)
    seen = jax.nn.dot_product_attention(query, key, value)
    tokens = tokens + _times(seen.reshape(*tokens.shape[:2], -1), network[f"{name}.0.fn.to_out.0"])
    fed = jax.nn.relu(_times(_normalised(tokens, network[f"{name}.1.norm"]), network[f"{name}.1.fn.net.0"]))
    return tokens + _times(fed, network[f"{name}.1.fn.net.3"])


def _between_patches(image: Float[Array, "h w c"], network: Layers, name: str) -> Float[Array, "h w c"]:
    """Convolutions, attention between patches, and convolutions of the result and the image."""
    local = _in_turn(image, layers(network, f"{name}.conv1", SEPARABLE))
    found = jax.nn.relu(convolve(jax.nn.relu(local), network[f"{name}.conv2.0"]))
    rows, columns, channels = found.shape[0] // PATCH, found.shape[1] // PATCH, found.shape[2]
    split = found.reshape(rows, PATCH, columns, PATCH, channels).transpose(1, 3, 0, 2, 4)
    tokens = _attend(split.reshape(PATCH**2, rows * columns, channels), network, f"{name}.transformer.layers.0")
    joined = tokens.reshape(split.shape).transpose(2, 0, 3, 1, 4).reshape(found.shape)
    beside = jnp.concatenate([jax.nn.relu(convolve(joined, network[f"{name}.conv3.0"])), image], axis=-1)
    return jax.nn.relu(_in_turn(beside, layers(network, f"{name}.conv4", SEPARABLE)))


@full_precision
def predict(network: Layers, image: Float[Array, "h w 3"]) -> Float[Array, "h4 w4"]:
    """Depth up to a factor, at a quarter of the size, of an RGB image in [0, 1]; sides are multiples of 64."""
    first = layers(network, "encoder.conv1", SEPARABLE)
    image, kept = jax.nn.relu(_in_turn(jax.nn.standardize(image, axis=None), first)), []
    for number in range(7):
        found = chain(image, layers(network, f"encoder.mv2.{number}.conv", (0, 3, 6)))
        image = image + found if found.shape == image.shape else found
        if number in HALVING:
            kept.append(image)
        if number >= FIRST_PATCHES:
            image = _between_patches(image, network, f"encoder.mvit.{number - FIRST_PATCHES}")
    image = convolve(jax.nn.relu(convolve(image, network["encoder.conv2.0"])), network["decoder.conv2d_in"])
    for number, beside in zip((1, 2, 3), kept[2::-1], strict=True):
        name = f"decoder.ups_block_{number}"
        both = jnp.concatenate([convolve(image, network[f"{name}.conv2d_transpose"]), beside], axis=-1)
        image = jax.nn.relu(_in_turn(both, layers(network, f"{name}.end_up_layer", SEPARABLE)))
    return convolve(image, network["decoder.conv2d_out"])[..., 0]


def build_network(tensors: Tensors) -> Layers:
    """Build the network from tensors with the published names; KeyError if one is missing."""

    def separable(name: str, stride: int = 1) -> dict[str, dict[str, Any]]:
        return {f"{name}.0.depthwise": {"stride": stride}, f"{name}.0.pointwise": {"norm": f"{name}.1"}}

    told = separable("encoder.conv1", 2) | {"encoder.conv2.0": {"norm": "encoder.conv2.1"}}
    for number in range(7):
        name, stride = f"encoder.mv2.{number}.conv", 2 if number in HALVING else 1
        told |= {f"{name}.{n}": {"norm": f"{name}.{n + 1}", "stride": stride if n == 3 else 1} for n in (0, 3, 6)}
    patches = [f"encoder.mvit.{number}" for number in range(3)]
    for name in patches:
        told |= separable(f"{name}.conv1") | separable(f"{name}.conv4")
        told |= {f"{name}.conv{n}.0": {"norm": f"{name}.conv{n}.1"} for n in (2, 3)}
    for number in (1, 2, 3):
        name = f"decoder.ups_block_{number}"
        told |= {f"{name}.end_up_layer.{each}": {} for each in SEPARABLE}
        told |= {f"{name}.conv2d_transpose": {"expansion": 2}}
    told |= {"decoder.conv2d_in": {}, "decoder.conv2d_out": {}}
    attention = ("0.norm", "0.fn.to_qkv", "0.fn.to_out.0", "1.norm", "1.fn.net.0", "1.fn.net.3")
    matrices = [f"{name}.transformer.layers.0.{layer}" for name in patches for layer in attention]
    return read_layers(tensors, told) | {name: _linear(tensors, name) for name in matrices}


def _linear(part: Tensors, name: str) -> Linear:
    weight = part[f"{name}.weight"].T
    return Linear(jnp.asarray(weight), jnp.asarray(part.get(f"{name}.bias", np.zeros(weight.shape[-1], np.float32))))
