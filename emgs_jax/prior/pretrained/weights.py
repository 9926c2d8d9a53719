"""Published weights: checked, read without running any code of the file, and put where they belong.

A batch normalisation that follows a convolution is a factor and an offset of each channel, so it becomes part of it.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from emgs_jax.io.torch_tensors import read_tensors
from emgs_jax.prior.pretrained.layers import Conv

NORM_EPSILON = 1e-5  # of the variance, as in training

Tensors = Mapping[str, np.ndarray]
Layers = dict[str, Conv]  # by their names in the published file
Network = TypeVar("Network")


def load_network(
    checkpoint: str | None, sha256: str, source: str, key: str | None, build: Callable[[Tensors], Network]
) -> Network:
    """The network of a file as its authors publish it.

    Args:
        checkpoint: path of the file.
        sha256: of the file, in hexadecimal digits.
        source: where it is published.
        key: of what was saved, under which the tensors stand; None = they are all.
        build: the network of its tensors; KeyError names one that is missing.

    Raises:
        ValueError: there is no such file, or it is another one.
    """
    if checkpoint is None or not Path(checkpoint).expanduser().is_file():
        raise ValueError(f"prior.dense.checkpoint={checkpoint} is no file: give the path of {source}")
    content = Path(checkpoint).expanduser().read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != sha256:
        raise ValueError(
            f"{checkpoint} has the SHA-256 {digest}, expected {sha256}: fetch {source} again, or give "
            "prior.dense.sha256= for weights of your own"
        )
    try:
        return build(read_tensors(content, key))
    except (ValueError, KeyError) as error:
        raise ValueError(f"{checkpoint} has not the weights of {source}: {error}") from error


def conv(
    part: Tensors,
    name: str,
    norm: str | None = None,
    stride: int = 1,
    dilation: int = 1,
    expansion: int = 1,
) -> Conv:
    """The convolution `name`, transposed where it expands, with the batch normalisation `norm` after it."""
    weight = np.float64(part[f"{name}.weight"])
    if expansion == 1:
        weight = np.moveaxis(weight, (0, 1), (-1, -2))
    else:  # that of the expanded image, turned round
        weight = np.moveaxis(np.flip(weight, range(2, weight.ndim)), (0, 1), (-2, -1))
    bias = np.float64(part.get(f"{name}.bias", np.zeros(weight.shape[-1])))
    if norm is not None:
        scale, offset, mean, variance = (
            np.float64(part[f"{norm}.{key}"]) for key in ("weight", "bias", "running_mean", "running_var")
        )
        factor = scale / np.sqrt(variance + NORM_EPSILON)
        weight, bias = weight * factor, offset + factor * (bias - mean)
    return Conv(jnp.asarray(weight, jnp.float32), jnp.asarray(bias, jnp.float32), stride, dilation, expansion)


def read_layers(part: Tensors, told: Mapping[str, Mapping[str, Any]]) -> Layers:
    """Convolutions, each with what `conv` is told of it; `is_block`: it is NAME.conv, and NAME.bn comes after it."""
    found = {}
    for name, options in told.items():
        names = (f"{name}.conv", f"{name}.bn") if options.get("is_block") else (name,)
        found[name] = conv(part, *names, **{key: value for key, value in options.items() if key != "is_block"})
    return found


def layers(network: Mapping[str, Any], prefix: str, names: Iterable[object]) -> list[Conv]:
    """Those that are called PREFIX.NAME."""
    return [network[f"{prefix}.{name}"] for name in names]
