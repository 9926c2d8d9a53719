"""The published weights of IterMVS: checked, read without running any code of the file, and put where they belong.

A batch normalisation that follows a convolution is a factor and an offset of each channel, so it becomes part of it.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from emgs_jax.io.torch_tensors import read_tensors
from emgs_jax.prior.itermvs.layers import Conv
from emgs_jax.prior.itermvs.network import FeatureNet, Gru, IterMVS, Residual

SOURCE = "https://github.com/FangjinhuaWang/IterMVS (MIT), checkpoints/blendedmvs/model_000015.ckpt"
NORM_EPSILON = 1e-5  # of the variance, as in training

Tensors = Mapping[str, np.ndarray]


def load_weights(checkpoint: str | None, sha256: str) -> IterMVS:
    """The network of a file as its authors publish it.

    Args:
        checkpoint: path of the file.
        sha256: of the file, in hexadecimal digits.

    Raises:
        ValueError: there is no such file, or it is another one.
    """
    if checkpoint is None or not Path(checkpoint).expanduser().is_file():
        raise ValueError(f"prior.dense.checkpoint={checkpoint} is no file: give the path of {SOURCE}")
    content = Path(checkpoint).expanduser().read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != sha256:
        raise ValueError(
            f"{checkpoint} has the SHA-256 {digest}, expected {sha256}: fetch {SOURCE} again, or give "
            "prior.dense.sha256= for weights of your own"
        )
    try:
        return build_network(read_tensors(content, "model"))
    except (ValueError, KeyError) as error:
        raise ValueError(f"{checkpoint} has no weights of IterMVS: {error}") from error


def build_network(tensors: Tensors) -> IterMVS:
    """The network of tensors that are named as in the published file; KeyError names one that is missing."""
    part = {name.removeprefix("module."): value for name, value in tensors.items()}
    update, match = "iter_mvs.update", "iter_mvs.evaluation.corr_conv1"
    visibility = "iter_mvs.evaluation.pixel_view_weight.conv"
    return IterMVS(
        features=_feature_net(part, "feature_net"),
        visibility=(_conv(part, f"{visibility}.0.conv"), _conv(part, f"{visibility}.1")),
        matching=tuple(_matching(part, f"{match}.{scale}") for scale in range(3)),
        hidden=_convs(part, f"{update}.hidden_init_head", (0, 2)),
        gru=Gru(*(_conv(part, f"{update}.gru.conv{name}", dilation=2) for name in "zrq")),
        depth=_convs(part, f"{update}.depth_head", (0, 2, 4), dilation=2),
        confidence=_convs(part, f"{update}.confidence_head", (0, 2), dilation=2),
        upsampling=_convs(part, "iter_mvs.upsample", (0, 2)),
    )


def _conv(part: Tensors, name: str, stride: int = 1, dilation: int = 1) -> Conv:
    weight = np.float32(part[f"{name}.weight"])
    bias = np.float32(part.get(f"{name}.bias", np.zeros(len(weight))))
    return Conv(jnp.asarray(weight.transpose(2, 3, 1, 0)), jnp.asarray(bias), stride, dilation, 1)


def _convs(part: Tensors, name: str, numbers: tuple[int, ...], dilation: int = 1) -> tuple[Conv, ...]:
    """A chain of which the first is dilated."""
    return tuple(_conv(part, f"{name}.{n}", 1, dilation if n == 0 else 1) for n in numbers)


def _normalised(part: Tensors, name: str, stride: int = 1) -> Conv:
    """A convolution with the batch normalisation after it."""
    norm = {key: np.float64(part[f"{name}.bn.{key}"]) for key in ("weight", "bias", "running_mean", "running_var")}
    factor = norm["weight"] / np.sqrt(norm["running_var"] + NORM_EPSILON)
    weight = np.float32(part[f"{name}.conv.weight"] * factor[:, None, None, None])
    bias = np.float32(norm["bias"] - factor * norm["running_mean"])
    return Conv(jnp.asarray(weight.transpose(2, 3, 1, 0)), jnp.asarray(bias), stride, 1, 1)


def _expanding(part: Tensors, name: str) -> Conv:
    """A transposed convolution: that of the expanded image with the weights turned round."""
    weight = np.float32(part[f"{name}.weight"])[:, :, ::-1, ::-1].transpose(2, 3, 0, 1)
    return Conv(jnp.asarray(weight), jnp.zeros(weight.shape[-1]), 1, 1, 2)


def _matching(part: Tensors, name: str) -> tuple[Conv, ...]:
    down = (_conv(part, f"{name}.conv{number}.conv", min(number + 1, 2)) for number in range(3))
    return (*down, _expanding(part, f"{name}.conv3"), _expanding(part, f"{name}.conv4"), _conv(part, f"{name}.conv5"))


def _residual(part: Tensors, name: str, stride: int) -> Residual:
    convs = _normalised(part, f"{name}.conv1", stride), _normalised(part, f"{name}.conv2")
    return Residual(convs, _normalised(part, f"{name}.downsample", stride) if stride > 1 else None)


def _feature_net(part: Tensors, name: str) -> FeatureNet:
    return FeatureNet(
        first=_normalised(part, f"{name}.conv1"),
        blocks=tuple(_residual(part, f"{name}.layer{layer}.{n}", 2 - n) for layer in (1, 2, 3) for n in (0, 1)),
        lateral=tuple(_conv(part, f"{name}.inner{scale}") for scale in (1, 2)),
        out=tuple(_conv(part, f"{name}.output{scale}") for scale in (1, 2, 3)),
    )
