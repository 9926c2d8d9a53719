"""IterMVS: depth of a view by a recurrent network that matches it with others, and how sure it is.

Wang, Galliani, Vogel and Pollefeys, "IterMVS: Iterative Probability Estimation for Efficient Multi-View Stereo", CVPR
2022. Features of all images at a half, a quarter and an eighth of their size; at an eighth they are compared at depths
all over the range, which tells which other view shows the pixel, and begins the hidden state of a GRU; at a quarter the
GRU sees how well depths around the present one fit, at three scales, and says anew what is probable. Depths are numbers
from 0 (farthest) to 1 (nearest), linear in 1/z, so the unit of poses and range does not matter.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera, downscale, pixel_grid, rays
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static
from emgs_jax.ops.ranges import ranged
from emgs_jax.prior.pretrained.layers import Conv, chain, convolve, resize
from emgs_jax.prior.pretrained.matching import (
    COARSEST,
    FINEST,
    MIDDLE,
    Features,
    Gru,
    Sources,
    correlation,
    seen_from,
    turn,
    upsample,
)
from emgs_jax.prior.pretrained.weights import Tensors, conv

SOURCE = "https://github.com/FangjinhuaWang/IterMVS (MIT), checkpoints/blendedmvs/model_000015.ckpt"


def _steps() -> Any:
    return eqx.field(static=True, converter=tuple, metadata=ranged(-256, 256))


class IterMVSConfig(eqx.Module):
    """Sizes with which the weights were trained.

    Args:
        num_iterations: of the GRU.
        num_groups: of channels that are compared by themselves.
        num_initial: depths all over the range with which it begins.
        window: bins on either side of the most probable one over which the depth is averaged.
        finest_steps: of the depths around the present one that are tried on the finest features, in 1/256 of the range.
        middle_steps: likewise.
        coarsest_steps: likewise.
    """

    num_iterations: int = static(low=1, high=64)
    num_groups: int = static(low=1, high=16)
    num_initial: int = static(low=2, high=256)
    window: int = static(low=0, high=128)
    finest_steps: tuple[float, ...] = _steps()
    middle_steps: tuple[float, ...] = _steps()
    coarsest_steps: tuple[float, ...] = _steps()


class Residual(eqx.Module):
    """Two convolutions whose result is added to the image, or to what `shortcut` makes of it."""

    convs: tuple[Conv, ...]
    shortcut: Conv | None


class FeatureNet(eqx.Module):
    """Features at three scales: down by `blocks`, two for each halving, and up again by `lateral` and `out`."""

    first: Conv
    blocks: tuple[Residual, ...]
    lateral: tuple[Conv, ...]
    out: tuple[Conv, ...]


class IterMVS(eqx.Module):
    """Weights of the whole network; tuples of three are for the finest, middle and coarsest features."""

    features: FeatureNet
    visibility: tuple[Conv, ...]
    matching: tuple[tuple[Conv, ...], ...]
    hidden: tuple[Conv, ...]
    gru: Gru
    depth: tuple[Conv, ...]
    confidence: tuple[Conv, ...]
    upsampling: tuple[Conv, ...]


def _double(image: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    return resize(image, (2 * image.shape[0], 2 * image.shape[1]))


@full_precision
def extract(network: IterMVS, image: Float[Array, "h w 3"]) -> Features:
    """Features of an RGB image in [0, 1] whose height and width are multiples of 32."""
    network = network.features
    image = jax.nn.relu(convolve(2.0 * image - 1.0, network.first))
    scales = []
    for block in network.blocks:
        kept = image if block.shortcut is None else convolve(image, block.shortcut)
        image = jax.nn.relu(chain(image, block.convs) + kept)
        scales.append(image)
    half, quarter, eighth = scales[1::2]
    middle = _double(eighth) + convolve(quarter, network.lateral[1])
    finest = _double(middle) + convolve(half, network.lateral[0])
    return Features(*(convolve(image, last) for image, last in zip((finest, middle, eighth), network.out, strict=True)))


def _from_unit(values: Array, depth_range: Float[Array, "2"]) -> Array:
    """0 (farthest) to 1 (nearest) -> depth z."""
    near, far = 1.0 / depth_range[0], 1.0 / depth_range[1]
    return 1.0 / (far + values * (near - far))


def _match(convs: tuple[Conv, ...], correlation: Float[Array, "n h w g"]) -> Float[Array, "h w n"]:
    """How well each depth fits its surroundings: down twice, up twice, with what was there added."""
    full = jax.nn.relu(convolve(correlation, convs[0]))
    half = jax.nn.relu(convolve(full, convs[1]))
    quarter = jax.nn.relu(convolve(half, convs[2]))
    full = full + convolve(half + convolve(quarter, convs[3]), convs[4])
    return jnp.moveaxis(convolve(full, convs[5])[..., 0], 0, -1)


def _regress(logits: Float[Array, "h w d"], window: int) -> Float[Array, "h w"]:
    """The mean of the bins around the most probable one, from 0 to 1; at the ends the last bin counts again."""
    probability, last = jax.nn.softmax(logits, axis=-1), logits.shape[-1] - 1
    bins = jnp.clip(jnp.argmax(logits, axis=-1)[..., None] + jnp.arange(-window, window + 1), 0, last)
    weights = jnp.take_along_axis(probability, bins, axis=-1)
    return jnp.sum(bins * weights, axis=-1) / (jnp.sum(weights, axis=-1) + 1e-6) / last


def _initial(
    network: IterMVS,
    reference: Float[Array, "h w c"],
    sources: Sources,
    depth_range: Float[Array, "2"],
    camera: Camera,
    config: IterMVSConfig,
) -> tuple[Float[Array, "h w n"], Float[Array, "s h w"]]:
    """How well depths all over the range fit, at an eighth of the size, and how far each source shows each pixel."""
    depths = _from_unit(jnp.linspace(0.0, 1.0, config.num_initial), depth_range)
    camera = downscale(camera, COARSEST)
    points = depths[:, None, None, None] * rays(camera, pixel_grid(camera))

    def add(total: tuple[Array, Array], source: Sources) -> tuple[tuple[Array, Array], Array]:
        seen = seen_from(points, source)
        found = correlation(reference, source.features.coarsest, seen, camera, config.num_groups)
        scores = chain(found, network.visibility)[..., 0]
        weight = jnp.max(jax.nn.softmax(scores, axis=0), axis=0) * source.is_used
        return (total[0] + weight[..., None] * found, total[1] + weight), weight

    empty = jnp.zeros((*points.shape[:3], config.num_groups)), jnp.full(points.shape[1:3], 1e-5)
    (total, weights), each = jax.lax.scan(add, empty, sources)
    return _match(network.matching[2], total / weights[..., None]), each


def _around(
    network: IterMVS,
    references: Features,
    sources: tuple[Sources, Float[Array, "s h w"]],
    points: tuple[Float[Array, "_ h w 3"], ...],
    camera: Camera,
    config: IterMVSConfig,
) -> Float[Array, "h w n"]:
    """How well depths around the present one fit, at a quarter of the size, on the features of three scales.

    Args:
        references: features of the view, all at a quarter of its size.
        sources: and how far each shows each pixel.
        points: of the view's camera, for each scale.
        camera: of the images.
    """
    cameras = [downscale(camera, scale) for scale in (FINEST, MIDDLE, COARSEST)]

    def add(total: tuple[Array, ...], given: tuple[Sources, Array]) -> tuple[tuple[Array, ...], None]:
        source, weight = given
        scales = zip(references, source.features, points, cameras, strict=True)
        found = (correlation(r, s, seen_from(p, source), c, config.num_groups) for r, s, p, c in scales)
        return tuple(t + weight[..., None] * f for t, f in zip(total, found, strict=True)), None

    empty = tuple(jnp.zeros((*scale.shape[:3], config.num_groups)) for scale in points)
    total, _ = jax.lax.scan(add, empty, sources)
    weights = 1e-5 + jnp.sum(sources[1], axis=0)[..., None]
    return jnp.concatenate([_match(m, t / weights) for m, t in zip(network.matching, total, strict=True)], axis=-1)


@full_precision
def estimate(
    network: IterMVS,
    reference: Features,
    sources: Sources,
    depth_range: Float[Array, "2"],
    camera: Camera,
    config: IterMVSConfig,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Depth z of every pixel, in the unit of poses and range, and how sure it is, from 0 to 1.

    Without a source that counts both mean nothing.

    Args:
        depth_range: nearest and farthest depth.
        camera: of all images; width and height are multiples of 32.
    """
    fits, weights = _initial(network, reference.coarsest, sources, depth_range, camera, config)
    hidden = jnp.tanh(_double(chain(fits, network.hidden)))
    size = hidden.shape[:2]
    weights = jnp.moveaxis(_double(jnp.moveaxis(weights, 0, -1)), -1, 0)
    references = Features(*(resize(feature, size) for feature in reference))
    directions = rays(camera, MIDDLE * pixel_grid(downscale(camera, MIDDLE)))
    all_steps = config.finest_steps, config.middle_steps, config.coarsest_steps

    def points_around(unit: Array, steps: tuple[float, ...]) -> Array:
        tried = jnp.clip(unit + jnp.asarray(steps)[:, None, None] / 256.0, 0.0, 1.0)
        return _from_unit(tried, depth_range)[..., None] * directions

    def iterate(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        hidden, unit = state
        points = tuple(points_around(unit, steps) for steps in all_steps)
        fits = _around(network, references, (sources, weights), points, camera, config)
        hidden = turn(hidden, jnp.concatenate([unit[..., None], fits], axis=-1), network.gru)
        return (hidden, _regress(chain(hidden, network.depth), config.window)), None

    unit = _regress(chain(hidden, network.depth), config.window)
    (hidden, unit), _ = jax.lax.scan(iterate, (hidden, unit), length=config.num_iterations)
    depth = _from_unit(upsample(unit, chain(reference.middle, network.upsampling), "edge"), depth_range)
    confidence = jax.nn.sigmoid(chain(hidden, network.confidence))
    return depth, resize(confidence, depth.shape)[..., 0]


def build_network(tensors: Tensors) -> IterMVS:
    """The network of tensors that are named as in the published file; KeyError names one that is missing."""
    part = {name.removeprefix("module."): value for name, value in tensors.items()}
    update, match = "iter_mvs.update", "iter_mvs.evaluation.corr_conv1"
    visibility = "iter_mvs.evaluation.pixel_view_weight.conv"
    return IterMVS(
        features=_feature_net(part, "feature_net"),
        visibility=(conv(part, f"{visibility}.0.conv"), conv(part, f"{visibility}.1")),
        matching=tuple(_matching(part, f"{match}.{scale}") for scale in range(3)),
        hidden=_convs(part, f"{update}.hidden_init_head", (0, 2)),
        gru=Gru(*(conv(part, f"{update}.gru.conv{name}", dilation=2) for name in "zrq")),
        depth=_convs(part, f"{update}.depth_head", (0, 2, 4), dilation=2),
        confidence=_convs(part, f"{update}.confidence_head", (0, 2), dilation=2),
        upsampling=_convs(part, "iter_mvs.upsample", (0, 2)),
    )


def _convs(part: Tensors, name: str, numbers: tuple[int, ...], dilation: int = 1) -> tuple[Conv, ...]:
    """A chain of which the first is dilated."""
    return tuple(conv(part, f"{name}.{n}", dilation=dilation if n == 0 else 1) for n in numbers)


def _normalised(part: Tensors, name: str, stride: int = 1) -> Conv:
    return conv(part, f"{name}.conv", f"{name}.bn", stride)


def _matching(part: Tensors, name: str) -> tuple[Conv, ...]:
    down = (conv(part, f"{name}.conv{number}.conv", stride=min(number + 1, 2)) for number in range(3))
    up = (conv(part, f"{name}.conv{number}", expansion=2) for number in (3, 4))
    return (*down, *up, conv(part, f"{name}.conv5"))


def _residual(part: Tensors, name: str, stride: int) -> Residual:
    convs = _normalised(part, f"{name}.conv1", stride), _normalised(part, f"{name}.conv2")
    return Residual(convs, _normalised(part, f"{name}.downsample", stride) if stride > 1 else None)


def _feature_net(part: Tensors, name: str) -> FeatureNet:
    return FeatureNet(
        first=_normalised(part, f"{name}.conv1"),
        blocks=tuple(_residual(part, f"{name}.layer{layer}.{n}", 2 - n) for layer in (1, 2, 3) for n in (0, 1)),
        lateral=tuple(conv(part, f"{name}.inner{scale}") for scale in (1, 2)),
        out=tuple(conv(part, f"{name}.output{scale}") for scale in (1, 2, 3)),
    )
