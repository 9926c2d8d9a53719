"""Weights of IterMVS as the published file names and shapes them, drawn at random."""

import numpy as np

from emgs_jax.prior.pretrained.itermvs import build_network
from emgs_jax.prior.pretrained.weights import Layers


def _norm(channels: int) -> dict[str, tuple[int, ...]]:
    return {f"bn.{name}": (channels,) for name in ("weight", "bias", "running_mean", "running_var")}


def _shapes() -> dict[str, tuple[int, ...]]:
    """Of every tensor: those of a transposed convolution have the channels of the input first."""
    found: dict[str, tuple[int, ...]] = {}

    def add(name: str, weight: tuple[int, ...], has_bias: bool = False) -> None:
        found[f"{name}.weight"] = weight
        if has_bias:
            found[f"{name}.bias"] = weight[:1]

    def add_normalised(name: str, weight: tuple[int, ...]) -> None:
        add(f"{name}.conv", weight)
        found.update({f"{name}.{key}": shape for key, shape in _norm(weight[0]).items()})

    net, mvs, sizes = "feature_net", "iter_mvs", (8, 16, 32, 48)
    add_normalised(f"{net}.conv1", (8, 3, 3, 3))
    for layer, (before, after) in enumerate(zip(sizes, sizes[1:], strict=False), start=1):
        for block, channels in ((0, before), (1, after)):
            add_normalised(f"{net}.layer{layer}.{block}.conv1", (after, channels, 3, 3))
            add_normalised(f"{net}.layer{layer}.{block}.conv2", (after, after, 3, 3))
        add_normalised(f"{net}.layer{layer}.0.downsample", (after, before, 3, 3))
        add(f"{net}.output{layer}", (after, 48, 3, 3), True)
        add(f"{net}.inner{layer}", (48, after, 1, 1), True)
    add(f"{mvs}.evaluation.pixel_view_weight.conv.0.conv", (16, 8, 3, 3))
    add(f"{mvs}.evaluation.pixel_view_weight.conv.1", (1, 16, 1, 1), True)
    for scale in range(3):
        name = f"{mvs}.evaluation.corr_conv1.{scale}"
        for number, shape in enumerate(((8, 8, 3, 3), (16, 8, 3, 3), (32, 16, 3, 3))):
            add(f"{name}.conv{number}.conv", shape)
        add(f"{name}.conv3", (32, 16, 3, 3))
        add(f"{name}.conv4", (16, 8, 3, 3))
        add(f"{name}.conv5", (1, 8, 3, 3), True)
    for gate in "zrq":
        add(f"{mvs}.update.gru.conv{gate}", (32, 43, 3, 3), True)
    heads = {
        "depth_head": (((32, 32, 3, 3), False), ((64, 32, 1, 1), False), ((256, 64, 1, 1), True)),
        "confidence_head": (((32, 32, 3, 3), False), ((1, 32, 1, 1), True)),
        "hidden_init_head": (((64, 32, 3, 3), False), ((32, 64, 1, 1), True)),
    }
    for head, convs in heads.items():
        for number, (shape, has_bias) in enumerate(convs):
            add(f"{mvs}.update.{head}.{2 * number}", shape, has_bias)
    add(f"{mvs}.upsample.0", (64, 32, 3, 3))
    add(f"{mvs}.upsample.2", (144, 64, 1, 1))
    return {f"module.{name}": shape for name, shape in found.items()}


def random_tensors(seed: int = 0) -> dict[str, np.ndarray]:
    """Every tensor of the published file, so scaled that images survive all layers."""
    rng = np.random.default_rng(seed)

    def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
        if name.endswith(("bn.weight", "running_var")):
            return np.float32(rng.uniform(0.5, 1.5, shape))
        scale = np.sqrt(2.0 / np.prod(shape[1:])) if len(shape) == 4 else 0.1
        return np.float32(scale * rng.normal(size=shape))

    return {name: draw(name, shape) for name, shape in _shapes().items()}


def random_network(seed: int = 0) -> Layers:
    return build_network(random_tensors(seed))
