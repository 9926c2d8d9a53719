"""IterMVS: depth of a view, and its confidence, by a recurrent multi-view stereo network.

Wang, Galliani, Vogel and Pollefeys, "IterMVS: Iterative Probability Estimation for Efficient Multi-View Stereo", CVPR
2022. At an eighth of the size features are compared at depths all over the range, which gives each source's visibility
and the initial hidden state of a GRU. At a quarter the GRU sees how well depths around the present one fit, at three
scales, and updates it. Depths are numbers from 0 (farthest) to 1 (nearest), linear in 1/z, so any unit will do.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera, downscale, pixel_grid, rays
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static
from emgs_jax.ops.ranges import ranged
from emgs_jax.prior.pretrained.layers import Conv, chain, convolve, resize, sample
from emgs_jax.prior.pretrained.weights import Layers, Tensors, layers, read_layers
from emgs_jax.prior.sources import Sources

FINEST, MIDDLE, COARSEST = 2, 4, 8  # image pixels per pixel of the features
UPDATE, EVALUATION = "iter_mvs.update", "iter_mvs.evaluation"
MATCHING = {"conv0.conv": {}, "conv1.conv": {"stride": 2}, "conv2.conv": {"stride": 2}}
MATCHING |= {"conv3": {"expansion": 2}, "conv4": {"expansion": 2}, "conv5": {}}
HEADS = {"hidden_init_head": (0, 2), "depth_head": (0, 2, 4), "confidence_head": (0, 2)}
SOURCE = "https://github.com/FangjinhuaWang/IterMVS (MIT), checkpoints/blendedmvs/model_000015.ckpt"


def _steps(*default: float) -> Any:
    return eqx.field(default=default, static=True, converter=tuple, metadata=ranged(-256, 256))


class IterMVSConfig(eqx.Module):
    """Sizes with which the weights were trained."""

    num_iterations: int = static(4, low=1, high=64)  # of the GRU
    num_groups: int = static(8, low=1, high=16)  # of channels, compared separately
    num_initial: int = static(32, low=2, high=256)  # depths all over the range
    window: int = static(4, low=0, high=128)  # bins on either side of the most probable, over which depth is averaged
    # Offsets of the depths to try around the present one, for each scale of the features, in 1/256 of the range.
    finest_steps: tuple[float, ...] = _steps(-2.0, -0.6666667, 0.6666667, 2.0)
    middle_steps: tuple[float, ...] = _steps(-8.0, -2.6666667, 2.6666667, 8.0)
    coarsest_steps: tuple[float, ...] = _steps(-32.0, 32.0)


class Features(NamedTuple):
    """Features of one image, at 1/2, 1/4 and 1/8 of its size."""

    finest: Float[Array, "*b h2 w2 c2"]
    middle: Float[Array, "*b h4 w4 c4"]
    coarsest: Float[Array, "*b h8 w8 c8"]


def inverse_between(unit: Array, depth_range: Float[Array, "2"]) -> Array:
    """1/z of a depth from 0 (farthest) to 1 (nearest)."""
    near, far = 1.0 / depth_range[0], 1.0 / depth_range[1]
    return far + unit * (near - far)


def seen_from(points: Float[Array, "*b 3"], source: Sources) -> Float[Array, "*b 3"]:
    """Points of the reference camera in that of a source."""
    return points @ source.T_source_view.rotation().as_matrix().T + source.T_source_view.translation()


def correlation(
    reference: Float[Array, "h w c"],
    source: Float[Array, "h2 w2 c"],
    points: Float[Array, "n h w 3"],
    camera: Camera,
    num_groups: int,
) -> Float[Array, "n h w g"]:
    """Mean product of each group's channels, of the pixels' features and those where the source sees their points.

    Points are in the source's camera, `camera` is that of its features; zero where the source does not see them.
    """
    is_ahead = points[..., 2] > 0
    pixels = camera.focal * points[..., :2] / jnp.where(is_ahead, points[..., 2], 1.0)[..., None] + camera.center
    product = sample(source, pixels, is_ahead) * reference
    return jnp.mean(product.reshape(*product.shape[:-1], num_groups, -1), axis=-1)


def upsample(values: Float[Array, "h w"], logits: Float[Array, "h w k"]) -> Float[Array, "h2 w2"]:
    """Upsample r times: each pixel is a convex combination of nine values (Teed and Deng, ECCV 2020); k = 9 r²."""
    (height, width), ratio = values.shape, math.isqrt(logits.shape[-1] // 9)
    padded = jnp.pad(values, 1, mode="edge")
    around = jnp.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=-1)
    weights = jax.nn.softmax(logits.reshape(height, width, 9, ratio, ratio), axis=2)
    return jnp.einsum("hwk,hwkyx->hywx", around, weights).reshape(ratio * height, ratio * width)


def turn(hidden: Float[Array, "h w c"], seen: Float[Array, "h w i"], gates: Sequence[Conv]) -> Float[Array, "h w c"]:
    """One step of a convolutional GRU with the gates update, reset and candidate."""
    both = jnp.concatenate([hidden, seen], axis=-1)
    update, reset = (jax.nn.sigmoid(convolve(both, gate)) for gate in gates[:2])
    candidate = jnp.tanh(convolve(jnp.concatenate([reset * hidden, seen], axis=-1), gates[2]))
    return (1.0 - update) * hidden + update * candidate


def _double(image: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    return resize(image, (2 * image.shape[0], 2 * image.shape[1]))


@full_precision
def extract(network: Layers, image: Float[Array, "h w 3"]) -> Features:
    """Features of an RGB image in [0, 1], whose sides are multiples of 32."""
    image = jax.nn.relu(convolve(2.0 * image - 1.0, network["feature_net.conv1"]))
    scales = []
    for layer in (1, 2, 3):
        for block in (0, 1):
            name = f"feature_net.layer{layer}.{block}"
            kept = convolve(image, network[f"{name}.downsample"]) if block == 0 else image
            image = jax.nn.relu(chain(image, layers(network, name, ("conv1", "conv2"))) + kept)
        scales.append(image)
    half, quarter, eighth = scales
    middle = _double(eighth) + convolve(quarter, network["feature_net.inner2"])
    finest = _double(middle) + convolve(half, network["feature_net.inner1"])
    last = layers(network, "feature_net", ("output1", "output2", "output3"))
    return Features(*(convolve(image, conv) for image, conv in zip((finest, middle, eighth), last, strict=True)))


def _match(network: Layers, scale: int, correlation: Float[Array, "n h w g"]) -> Float[Array, "h w n"]:
    """Score of each depth by a small U-Net; `scale` is that of the features, 0 for the finest."""
    convs = layers(network, f"{EVALUATION}.corr_conv1.{scale}", MATCHING)
    full = jax.nn.relu(convolve(correlation, convs[0]))
    half = jax.nn.relu(convolve(full, convs[1]))
    quarter = jax.nn.relu(convolve(half, convs[2]))
    full = full + convolve(half + convolve(quarter, convs[3]), convs[4])
    return jnp.moveaxis(convolve(full, convs[5])[..., 0], 0, -1)


def _regress(logits: Float[Array, "h w d"], window: int) -> Float[Array, "h w"]:
    """Mean of the bins around the most probable one, in [0, 1]; beyond the ends the last bin counts again."""
    probability, last = jax.nn.softmax(logits, axis=-1), logits.shape[-1] - 1
    bins = jnp.clip(jnp.argmax(logits, axis=-1)[..., None] + jnp.arange(-window, window + 1), 0, last)
    weights = jnp.take_along_axis(probability, bins, axis=-1)
    return jnp.sum(bins * weights, axis=-1) / (jnp.sum(weights, axis=-1) + 1e-6) / last


def _initial(
    network: Layers,
    reference: Float[Array, "h w c"],
    sources: Sources,
    depth_range: Float[Array, "2"],
    camera: Camera,
    config: IterMVSConfig,
) -> tuple[Float[Array, "h w n"], Float[Array, "s h w"]]:
    """Scores of depths all over the range at an eighth of the size, and each source's visibility of each pixel."""
    depths = 1.0 / inverse_between(jnp.linspace(0.0, 1.0, config.num_initial), depth_range)
    camera = downscale(camera, COARSEST)
    points = depths[:, None, None, None] * rays(camera, pixel_grid(camera))

    def add(total: tuple[Array, Array], source: Sources) -> tuple[tuple[Array, Array], Array]:
        seen = seen_from(points, source)
        found = correlation(reference, source.views.coarsest, seen, camera, config.num_groups)
        scores = chain(found, layers(network, f"{EVALUATION}.pixel_view_weight.conv", ("0.conv", "1")))[..., 0]
        weight = jnp.max(jax.nn.softmax(scores, axis=0), axis=0) * source.is_used
        return (total[0] + weight[..., None] * found, total[1] + weight), weight

    empty = jnp.zeros((*points.shape[:3], config.num_groups)), jnp.full(points.shape[1:3], 1e-5)
    (total, weights), each = jax.lax.scan(add, empty, sources)
    return _match(network, 2, total / weights[..., None]), each


def _around(
    network: Layers,
    references: Features,
    sources: tuple[Sources, Float[Array, "s h w"]],
    points: tuple[Float[Array, "_ h w 3"], ...],
    camera: Camera,
    config: IterMVSConfig,
) -> Float[Array, "h w n"]:
    """Scores of depths around the present one at a quarter of the size, on the features of three scales.

    `references` are resized to a quarter; `sources` come with their visibility; `points` are in the view's camera, for
    each scale; `camera` is that of the images.
    """
    cameras = [downscale(camera, scale) for scale in (FINEST, MIDDLE, COARSEST)]

    def add(total: tuple[Array, ...], given: tuple[Sources, Array]) -> tuple[tuple[Array, ...], None]:
        source, weight = given
        scales = zip(references, source.views, points, cameras, strict=True)
        found = (correlation(r, s, seen_from(p, source), c, config.num_groups) for r, s, p, c in scales)
        return tuple(t + weight[..., None] * f for t, f in zip(total, found, strict=True)), None

    empty = tuple(jnp.zeros((*scale.shape[:3], config.num_groups)) for scale in points)
    total, _ = jax.lax.scan(add, empty, sources)
    weights = 1e-5 + jnp.sum(sources[1], axis=0)[..., None]
    return jnp.concatenate([_match(network, scale, t / weights) for scale, t in enumerate(total)], axis=-1)


@full_precision
def estimate(
    network: Layers,
    reference: Features,
    sources: Sources,
    depth_range: Float[Array, "2"],
    camera: Camera,
    config: IterMVSConfig,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Depth z of every pixel, in the poses' unit, and its confidence in [0, 1]; meaningless without a used source.

    `depth_range` is the nearest and the farthest depth; the images' sides are multiples of 32.
    """
    fits, weights = _initial(network, reference.coarsest, sources, depth_range, camera, config)
    to_depth, to_confidence = (
        layers(network, f"{UPDATE}.{head}", HEADS[head]) for head in ("depth_head", "confidence_head")
    )
    hidden = jnp.tanh(_double(chain(fits, layers(network, f"{UPDATE}.hidden_init_head", HEADS["hidden_init_head"]))))
    size = hidden.shape[:2]
    weights = jnp.moveaxis(_double(jnp.moveaxis(weights, 0, -1)), -1, 0)
    references = Features(*(resize(feature, size) for feature in reference))
    directions = rays(camera, MIDDLE * pixel_grid(downscale(camera, MIDDLE)))
    all_steps = config.finest_steps, config.middle_steps, config.coarsest_steps

    def points_around(unit: Array, steps: tuple[float, ...]) -> Array:
        tried = jnp.clip(unit + jnp.asarray(steps)[:, None, None] / 256.0, 0.0, 1.0)
        return (1.0 / inverse_between(tried, depth_range))[..., None] * directions

    def iterate(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        hidden, unit = state
        points = tuple(points_around(unit, steps) for steps in all_steps)
        fits = _around(network, references, (sources, weights), points, camera, config)
        gates = layers(network, f"{UPDATE}.gru", ("convz", "convr", "convq"))
        hidden = turn(hidden, jnp.concatenate([unit[..., None], fits], axis=-1), gates)
        return (hidden, _regress(chain(hidden, to_depth), config.window)), None

    unit = _regress(chain(hidden, to_depth), config.window)
    (hidden, unit), _ = jax.lax.scan(iterate, (hidden, unit), length=config.num_iterations)
    unit = upsample(unit, chain(reference.middle, layers(network, "iter_mvs.upsample", (0, 2))))
    depth = 1.0 / inverse_between(unit, depth_range)
    confidence = jax.nn.sigmoid(chain(hidden, to_confidence))
    return depth, resize(confidence, depth.shape)[..., 0]


def build_network(tensors: Tensors) -> Layers:
    """Build the network from tensors with the published names; KeyError if one is missing."""
    told: dict[str, dict[str, Any]] = {"feature_net.conv1": {"is_block": True}}
    for name in (f"feature_net.layer{layer}.{block}" for layer in (1, 2, 3) for block in (0, 1)):
        first = {"is_block": True, "stride": 2 if name.endswith("0") else 1}
        told |= {f"{name}.conv1": first, f"{name}.conv2": {"is_block": True}}
        told |= {f"{name}.downsample": first} if name.endswith("0") else {}
    told |= {f"feature_net.{name}": {} for name in ("inner1", "inner2", "output1", "output2", "output3")}
    told |= {f"{EVALUATION}.pixel_view_weight.conv.{name}": {} for name in ("0.conv", "1")}
    for scale in range(3):
        told |= {f"{EVALUATION}.corr_conv1.{scale}.{name}": options for name, options in MATCHING.items()}
    for head, numbers in HEADS.items():
        dilation = 1 if head == "hidden_init_head" else 2
        told |= {f"{UPDATE}.{head}.{number}": {"dilation": 1 if number else dilation} for number in numbers}
    told |= {f"{UPDATE}.gru.conv{gate}": {"dilation": 2} for gate in "zrq"}
    told |= {f"iter_mvs.upsample.{number}": {} for number in (0, 2)}
    return read_layers({name.removeprefix("module."): value for name, value in tensors.items()}, told)
