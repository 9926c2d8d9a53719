"""Effi-MVS+: depth of a view by matching it with others, first coarsely all over the range, then finer around it.

Wang, Li, Zhang and Dai, "Efficient Multi-view Stereo by Dynamic Cost Volume and Cross-scale Propagation", IEEE TCSVT
2024. A volume says how well depths all over the range fit at an eighth of the image's size, and what a 3D network makes
of it gives a first depth and how sure that is. There, at a quarter and at a half a GRU reads both volumes around the
present depth, moves it a few times, and doubles it. Before the finer two the volumes are made anew around the depth,
from finer features and what the coarser ones said. Depths are numbers from 0 (farthest) to 1 (nearest), linear in 1/z,
so the unit of poses and range does not matter.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emgs_jax.ops.camera import Camera, downscale, pixel_grid, rays
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import static
from emgs_jax.prior.pretrained.layers import Conv, chain, convolve
from emgs_jax.prior.pretrained.matching import (
    COARSEST,
    FINEST,
    MIDDLE,
    Features,
    correlation,
    inverse_between,
    pyramid,
    seen_from,
    turn,
    upsample,
)
from emgs_jax.prior.pretrained.weights import Layers, Tensors, layers, read_layers
from emgs_jax.prior.sources import Sources

BLOCKS = (2, 3, 3, 3)  # convolutions at each scale of the features, whose first one halves it, but for the first scale
SOURCE = "https://github.com/bdwsq1996/Effi-MVS-plus (no licence stated), checkpoints/Effi_MVS_plus/model_tank.ckpt"


class EffiMVSConfig(eqx.Module):
    """Sizes with which the weights were trained.

    Args:
        num_initial: depths all over the range with which it begins.
        num_around: depths around the present one of a volume at a quarter and at a half.
        num_steps: of the range: a depth is read one of them away at a half of the size, two at a quarter, four at an
            eighth; a volume goes as many times `num_around` / 2 on either side.
        num_iterations: of each GRU.
    """

    num_initial: int = static(low=4, high=1024)
    num_around: int = static(low=2, high=256)
    num_steps: int = static(low=4, high=65536)
    num_iterations: int = static(low=1, high=64)


class Seen(NamedTuple):
    """What is kept of an image: features that are matched, and those that a GRU of this view begins with."""

    features: Features
    context: Features


class _Volumes(NamedTuple):
    """How well depths fit, and what the network makes of it, at depths evenly from one number to another."""

    fits: Float[Array, "d h w"]
    scores: Float[Array, "d h w"]
    ends: tuple[Array, Array]


def _relu_chain(image: Array, convs: Sequence[Conv]) -> Array:
    return jax.nn.relu(chain(image, convs))


def _repeat(image: Float[Array, "h w *c"]) -> Float[Array, "h2 w2 *c"]:
    return jnp.repeat(jnp.repeat(image, 2, axis=0), 2, axis=1)


@full_precision
def extract(network: Layers, image: Float[Array, "h w 3"]) -> Seen:
    """Features of an RGB image in [0, 1] whose height and width are multiples of 32."""

    def features(name: str) -> Features:
        scale, scales = image, []
        for level, count in enumerate(BLOCKS):
            scale = _relu_chain(scale, layers(network, f"{name}.conv{level}", range(count)))
            scales.append(scale)
        lateral, out = (layers(network, name, names) for names in (("inner1", "inner2"), ("out3", "out2", "out1")))
        return pyramid(scales[1:], lateral, out, _repeat)

    return Seen(features("feature"), features("cnet_depth"))


def _inverse(unit: Array, depth_range: Float[Array, "2"]) -> Array:
    """`inverse_between`, which stays above 0 beyond the farthest."""
    return jnp.maximum(inverse_between(unit, depth_range), 1e-4 * (1.0 / depth_range[1]))


def _unit(depth: Array, depth_range: Float[Array, "2"]) -> Array:
    near, far = 1.0 / depth_range[0], 1.0 / depth_range[1]
    return (1.0 / depth - far) / (near - far)


def _correlations(
    reference: Float[Array, "h w c"],
    sources: Sources,
    of_source: tuple[Float[Array, "s h2 w2 c"], Camera],
    depths: Float[Array, "n h w"],
    weigh: list[Conv] | Float[Array, "s h w"],
) -> tuple[Float[Array, "n h w"], Float[Array, "s h w"]]:
    """How well depths fit, the mean over the sources by how far each shows each pixel, and those weights.

    Args:
        reference: features of the view.
        sources: the others.
        of_source: their features at this scale, and its camera.
        depths: of each pixel.
        weigh: the weights, or the network that tells them.
    """
    features, camera = of_source
    points = depths[..., None] * rays(camera, pixel_grid(camera))

    def add(total: tuple[Array, Array], given: tuple[Sources, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        source, feature, weight = given
        found = correlation(reference, feature, seen_from(points, source), camera, 1)[..., 0]
        if isinstance(weigh, list):
            share = jax.nn.softmax(found, axis=0)
            entropy = -jnp.sum(share * jnp.log(share + 1e-7), axis=0)
            weight = jax.nn.sigmoid(chain(entropy[..., None], weigh)[..., 0]) * source.is_used
        return (total[0] + weight * found, total[1] + weight), weight

    given = jnp.zeros((len(features), *depths.shape[1:])) if isinstance(weigh, list) else weigh
    empty = jnp.zeros_like(depths), jnp.zeros(depths.shape[1:])
    (total, weights), each = jax.lax.scan(add, empty, (sources, features, given))
    return total / (weights + 1e-6), each


def _regularize(fits: Float[Array, "d h w"], network: Layers) -> Float[Array, "d h w"]:
    """The scores of the first volume: down twice, up twice, with what was there added."""
    convs = layers(network, "cost_regularization", [f"conv{number}" for number in range(8)])
    full = _relu_chain(fits[..., None], convs[:2])
    half = _relu_chain(full, convs[2:4])
    quarter = _relu_chain(half, convs[4:6])
    half = half + jax.nn.relu(convolve(quarter, convs[6]))
    full = full + jax.nn.relu(convolve(half, convs[7]))
    return convolve(full, network["cost_regularization.prob"])[..., 0]


def _propagate(
    fits: Float[Array, "d h w"], coarser: Float[Array, "d h2 w2"], network: Layers, name: str
) -> Float[Array, "d h w"]:
    """From a volume at one scale and what was made of it at the coarser one to the same at this."""
    found = jax.nn.relu(convolve(fits[..., None], network[f"{name}.conv0"]))
    beside = jax.nn.relu(convolve(coarser[..., None], network[f"{name}.conv_cost"]))
    both = jnp.concatenate([found, beside], axis=-1)
    return _relu_chain(both, layers(network, name, ("conv1", "conv2")))[..., 0]


def _read(volume: Float[Array, "d h w"], ends: tuple[Array, Array], units: Float[Array, "n h w"]) -> Array:
    """Values of a volume at other depths, linearly between its own; zero beyond, which falls off within a step."""
    last = volume.shape[0] - 1
    place = jnp.clip((units - ends[0]) / (ends[1] - ends[0]) * last, -2.0, last + 2.0)
    low = jnp.floor(place)

    def at(index: Array) -> Array:
        inside = (index >= 0) & (index <= last)
        found = jnp.take_along_axis(volume, jnp.clip(index, 0, last).astype(jnp.int32), axis=0)
        return jnp.where(inside, (1.0 - jnp.abs(place - index)) * found, 0.0)

    return at(low) + at(low + 1)


def _around(unit: Float[Array, "h w"], reach: float, count: int) -> Float[Array, "n h w"]:
    return unit + reach * jnp.linspace(-1.0, 1.0, count)[:, None, None]


def _refine(
    unit: Float[Array, "h w"],
    context: Float[Array, "h w c"],
    volumes: _Volumes,
    network: Layers,
    name: str,
    step: float,
    num_iterations: int,
) -> Float[Array, "h2 w2"]:
    """Depth at twice the size, after the GRU has moved it."""
    gates = layers(network, f"{name}.depth_gru", ("convz", "convr", "convq"))
    size = gates[0].bias.shape[0]
    hidden, context = jnp.tanh(context[..., :size]), jax.nn.relu(context[..., size:])

    def iterate(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        hidden, unit = state
        tried = _around(unit, step, 3)
        read = [jnp.moveaxis(_read(volume, volumes.ends, tried), 0, -1) for volume in (volumes.fits, volumes.scores)]
        given = {"c": jnp.concatenate(read, axis=-1), "d": unit[..., None]}
        found = [
            _relu_chain(image, layers(network, f"{name}.encoder", (f"conv{kind}1", f"conv{kind}2")))
            for kind, image in given.items()
        ]
        mixed = convolve(jnp.concatenate(found, axis=-1), network[f"{name}.encoder.convd"])
        seen = convolve(jnp.concatenate([mixed, context], axis=-1), network[f"{name}.encoder.convc"])
        hidden = turn(hidden, jax.nn.relu(seen), gates)
        moved = jnp.tanh(chain(hidden, layers(network, f"{name}.depth_head", ("conv1", "conv2")))[..., 0])
        return (hidden, unit + moved), None

    (hidden, unit), _ = jax.lax.scan(iterate, (hidden, unit), length=num_iterations)
    return upsample(unit, 0.25 * chain(hidden, layers(network, f"{name}.mask", (0, 2))), "constant")


@full_precision
def estimate(
    network: Layers,
    reference: Seen,
    sources: Sources,
    depth_range: Float[Array, "2"],
    camera: Camera,
    config: EffiMVSConfig,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Depth z of every pixel, in the unit of poses and range, and how sure it is, from 0 to 1.

    Without a source that counts both mean nothing.

    Args:
        reference: what is kept of the view, and of the sources.
        depth_range: nearest and farthest depth.
        camera: of all images; width and height are multiples of 32.
    """
    # The coarsest scale is first.
    own, others, contexts = (kept[::-1] for kept in (reference.features, sources.views.features, reference.context))
    cameras = [downscale(camera, scale) for scale in (COARSEST, MIDDLE, FINEST)]
    sources = sources._replace(views=())
    units = jnp.linspace(0.0, 1.0, config.num_initial)
    depths = jnp.broadcast_to(1.0 / _inverse(units, depth_range)[:, None, None], (len(units), *own[0].shape[:2]))
    visibility = layers(network, "PixelwiseNet", range(4))
    fits, weights = _correlations(own[0], sources, (others[0], cameras[0]), depths, visibility)
    volumes = _Volumes(fits, _regularize(fits, network), (units[0], units[-1]))
    share = jax.nn.softmax(volumes.scores, axis=0)
    unit = _unit(jnp.sum(share * depths, axis=0), depth_range)
    for scale in range(3):
        step = 2.0 ** (2 - scale) / config.num_steps
        if scale > 0:
            tried = _around(unit, step * (config.num_around // 2), config.num_around)
            weights = jax.vmap(_repeat)(weights)
            depths = 1.0 / _inverse(tried, depth_range)
            fits, _ = _correlations(own[scale], sources, (others[scale], cameras[scale]), depths, weights)
            coarser = [_read(v, volumes.ends, tried[:, ::2, ::2]) for v in (volumes.fits, volumes.scores)]
            names = f"CSP_C{scale}", f"CSP_R{scale}"
            made = [_propagate(fits, volume, network, name) for volume, name in zip(coarser, names, strict=True)]
            volumes = _Volumes(*made, (tried[0], tried[-1]))
        name = f"update_block_depth{scale + 1}"
        unit = _refine(unit, contexts[scale], volumes, network, name, step, config.num_iterations)
    depth = 1.0 / _inverse(unit, depth_range)
    confidence = jax.image.resize(_confidence(share), depth.shape, "linear", antialias=False)
    return depth, confidence


def _confidence(share: Float[Array, "d h w"]) -> Float[Array, "h w"]:
    """What the four depths around the mean one have of the probability."""
    last = len(share) - 1
    mean = jnp.sum(share * jnp.arange(last + 1.0)[:, None, None], axis=0).astype(jnp.int32)
    around = jnp.clip(mean, 0, last) + jnp.arange(-1, 3)[:, None, None]
    found = jnp.take_along_axis(share, jnp.clip(around, 0, last), axis=0)
    return jnp.sum(jnp.where((around >= 0) & (around <= last), found, 0.0), axis=0)


def build_network(tensors: Tensors) -> Layers:
    """The network of tensors that are named as in the published file; KeyError names one that is missing."""
    plain, told = ["PixelwiseNet.3", "cost_regularization.prob"], {}
    for name in ("feature", "cnet_depth"):
        plain += [f"{name}.{layer}" for layer in ("inner1", "inner2", "out1", "out2", "out3")]
        for level, count in enumerate(BLOCKS):
            told |= {f"{name}.conv{level}.{n}": {"stride": 2 if level > 0 and n == 0 else 1} for n in range(count)}
    told |= {f"PixelwiseNet.{number}": {} for number in range(3)}
    told |= {f"cost_regularization.conv{n}": {"stride": stride} for n, stride in enumerate((1, 1, 2, 1, 2, 1))}
    told |= {f"cost_regularization.conv{n}": {"expansion": 2} for n in (6, 7)}
    for name in ("CSP_R1", "CSP_R2", "CSP_C1", "CSP_C2"):
        told |= {f"{name}.conv0": {"stride": (1, 2, 2)}, f"{name}.conv_cost": {}, f"{name}.conv1": {}}
        told |= {f"{name}.conv2": {"expansion": (1, 2, 2)}}
    updating = [f"encoder.conv{of}" for of in ("c1", "c2", "d1", "d2", "d", "c")]
    updating += ["depth_gru.convz", "depth_gru.convr", "depth_gru.convq", "depth_head.conv1", "depth_head.conv2"]
    plain += [f"update_block_depth{n}.{layer}" for n in (1, 2, 3) for layer in (*updating, "mask.0", "mask.2")]
    blocks = {name: options | {"is_block": True} for name, options in told.items()}
    return read_layers(tensors, blocks | {name: {} for name in plain})
