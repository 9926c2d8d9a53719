"""Load published weights: check the file, read it without running its code, and fold batch norms into convolutions."""

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
    """Load a network from a file with this SHA-256, as published at `source`; ValueError if it is missing or another.

    `key` is that of the tensors in what was saved (None: at the top); `build` makes the network of them.
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
    part: Tensors, name: str, norm: str | None = None, stride: int = 1, dilation: int = 1, expansion: int = 1
) -> Conv:
    """The convolution `name`, transposed if it expands, with the batch norm `norm` folded in."""
    weight = np.float64(part[f"{name}.weight"])
    if expansion == 1:
        weight = np.moveaxis(weight, (0, 1), (-1, -2))
    else:  # transposed
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
    """Convolutions by name, each with options for `conv`; `is_block`: it is NAME.conv, followed by NAME.bn."""
    found = {}
    for name, options in told.items():
        names = (f"{name}.conv", f"{name}.bn") if options.get("is_block") else (name,)
        found[name] = conv(part, *names, **{key: value for key, value in options.items() if key != "is_block"})
    return found


def layers(network: Mapping[str, Any], prefix: str, names: Iterable[object]) -> list[Conv]:
    return [network[f"{prefix}.{name}"] for name in names]
