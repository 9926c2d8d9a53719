"""Layers of a map that the page and the live viewer can show, at a few bytes a Gaussian, and their packing."""

import base64
import math
import zlib
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.device.arrays import on_device
from emgs_jax.drawing.colors import NO_CLASS, class_colors, rgb, to_bytes
from emgs_jax.features.text import TextEmbeddings
from emgs_jax.gaussian_map import GaussianMap, confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.semantics import principal_colors, similarities

COV_UNIT = 1e-4  # m²; float16 then holds standard deviations from .1 mm to 2.5 m
_LARGEST_HALF = 65504.0
_similarities, feature_colors = eqx.filter_jit(similarities), eqx.filter_jit(principal_colors)
_UPPER = np.triu_indices(3)
# Viewers draw Gaussians wide enough along the surface to leave no gaps.
_NUM_NEIGHBOURS = 6  # the number that touch a disc in a dense packing
_REACH = 2.0  # standard deviations to a neighbour; in between, opacities of .9 then add up to at least .9
_CANDIDATES = 18  # nearest means; those that face another way are no neighbours
_MIN_COSINE = 0.7  # between the normals of neighbours on one surface
LARGEST = 3.0  # largest factor on a Gaussian's width, so that an isolated one stays a spot


class Layer(NamedTuple):
    """A layer that a viewer can show: an array of `map_layers` or `feature_layer`.

    With a `scale` its numbers get their colour from their place between the 1st and the 99th percentile: `share` of
    255, `count` (its logarithm) or `number`.
    """

    title: str
    array: str
    scale: str = ""


LAYERS = {  # web/layers.js colours them in the same way
    "color": Layer("colour", "color"),
    "class": Layer("class", "label"),
    "similarity": Layer("similarity to a class", "similarity", "share"),
    "feature": Layer("features (main directions)", "feature"),
    "normal": Layer("normals", "normal"),
    "existence": Layer("certainty", "existence", "share"),
    "updates": Layer("updates", "updates", "count"),
    "birth": Layer("frame of birth", "birth", "number"),
}
ALWAYS = ("color", "normal", "existence", "updates", "birth")  # arrays of every map


def layers_of(arrays: Collection[str]) -> dict[str, Layer]:
    """Return the layers that these arrays can show."""
    return {name: layer for name, layer in LAYERS.items() if layer.array in arrays}


def painted(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Colour every Gaussian, uint8 (n, 3), by one of `LAYERS` that has one value of each."""
    layer = LAYERS[name]
    values = arrays[layer.array]
    if name == "class":
        colors = np.vstack([class_colors(arrays["similarity"].shape[1]), rgb(NO_CLASS)])  # row -1 is the last
        return to_bytes(colors[values])
    if name == "normal":
        return to_bytes(0.5 + values / 254.0)
    if not layer.scale:
        return values
    numbers = np.log10(1.0 + values) if layer.scale == "count" else values.astype(np.float64)
    low, high = np.percentile(numbers, [1, 99]) if len(numbers) else (0.0, 1.0)
    return to_bytes(matplotlib.colormaps["turbo"]((numbers - low) / (high - low if high > low else 1.0))[:, :3])


def covariances(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Unpack `cov` to (n, 3, 3) in square metres, float32."""
    covs = np.empty((len(arrays["cov"]), 3, 3), np.float32)
    covs[:, *_UPPER] = arrays["cov"].astype(np.float32) * COV_UNIT
    covs[:, _UPPER[1], _UPPER[0]] = covs[:, *_UPPER]
    return covs


def packed_covariances(covs: np.ndarray) -> np.ndarray:
    """Pack covariances (n, 3, 3) as float16 (n, 6): the upper triangles in `COV_UNIT`."""
    return np.clip(covs[:, *_UPPER] / COV_UNIT, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)


def closing_covariances(means: np.ndarray, covs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute covariances (n, 3, 3) that close the surface in an ordinary 3DGS rasterizer; for display only, float64.

    Each is widened along its surface until its sixth neighbour lies at `_REACH` standard deviations of its own
    covariance, so that it keeps its shape. None is narrowed, and the thickness along the unit normal stays.
    """
    means, covs, normals = (np.asarray(values, np.float64) for values in (means, covs, normals))
    if len(means) < 2:
        return covs
    rows = cKDTree(means).query(means, k=min(_CANDIDATES + 1, len(means)))[1][:, 1:]
    plane = np.eye(3) - normals[:, :, None] * normals[:, None]
    offsets = (means[rows] - means[:, None]) @ plane
    distance_sq = np.einsum("nki,nij,nkj->nk", offsets, np.linalg.inv(covs), offsets)
    faces_alike = np.einsum("nki,ni->nk", normals[rows], normals) > _MIN_COSINE
    distance_sq = np.sort(np.where(faces_alike, distance_sq, np.inf), axis=1)
    widening = np.clip(distance_sq[:, min(_NUM_NEIGHBOURS, rows.shape[1]) - 1] / _REACH**2, 1.0, LARGEST**2)
    return covs + (widening - 1.0)[:, None, None] * (plane @ covs @ plane)


def closed(gaussians: Gaussians) -> Gaussians:
    """Replace the covariances by `closing_covariances`; for display only."""
    rows = np.flatnonzero(gaussians.valid)
    covs = np.array(gaussians.covs)
    covs[rows] = closing_covariances(*(np.asarray(x)[rows] for x in (gaussians.means, covs, gaussians.normals)))
    return eqx.tree_at(lambda g: g.covs, gaussians, jnp.asarray(covs))


def map_layers(map: GaussianMap, text: TextEmbeddings | None) -> dict[str, np.ndarray]:
    """Return the attributes of each confirmed Gaussian that the page shows, in the order of the map.

    Returns:
        `mean` float32 (n, 3) in metres; `cov` float16 (n, 6), the upper triangle of `closing_covariances` in
        `COV_UNIT`; `color` uint8 (n, 3); `normal` int8 (n, 3), 127 = 1; `existence` uint8, the probability that it
        exists, 255 = 1; `updates` uint16; `birth` int32, the node of its first frame. With text, `label`
        int16, -1 = none, and `similarity` uint8 (n, c): the cosine with each class, 255 = 1, negative ones 0.
    """
    gaussians = jax.device_get(confirmed(map))
    rows = np.flatnonzero(gaussians.valid)
    means, covs, normals = (np.asarray(x)[rows] for x in (gaussians.means, gaussians.covs, gaussians.normals))
    covs = closing_covariances(means, covs, normals)
    layers = {
        "mean": means.astype(np.float32),
        "cov": packed_covariances(covs),
        "color": to_bytes(np.asarray(gaussians.colors)[rows]),
        "normal": np.rint(127 * normals).astype(np.int8),
        "existence": to_bytes(1.0 / (1.0 + np.exp(-np.asarray(map.existence, np.float64)[rows]))),
        "updates": np.minimum(np.asarray(map.num_updates)[rows], 65535).astype(np.uint16),
        "birth": np.asarray(map.birth)[rows].astype(np.int32),
    }
    if text is None or not len(rows):
        return layers
    if text.vectors.shape[1] != gaussians.features.shape[1]:
        raise ValueError(
            f"text.npz has embeddings of width {text.vectors.shape[1]} and map.npz features of width "
            f"{gaussians.features.shape[1]}: they are of two runs, run again"
        )
    cosines = np.asarray(_similarities(confirmed(map), on_device(text.vectors)))[rows]
    is_known = np.asarray(map.gaussians.features)[rows].any(-1)
    labels = np.where(is_known, cosines.argmax(1), -1).astype(np.int16)
    return layers | {"label": labels, "similarity": to_bytes(cosines)}


def feature_layer(map: GaussianMap) -> dict[str, np.ndarray]:
    """Return `feature` uint8 (n, 3), the features' principal directions as RGB (`principal_colors`); empty without any.

    Rows as in `map_layers`.
    """
    gaussians = confirmed(map)
    rows = np.flatnonzero(gaussians.valid)
    if not np.asarray(gaussians.features)[rows].any():
        return {}
    return {"feature": to_bytes(np.asarray(feature_colors(gaussians))[rows])}


def thinned(layers: Mapping[str, np.ndarray], weight: np.ndarray, count: int) -> dict[str, np.ndarray]:
    """Keep the `count` rows of largest weight, in their order; all of them if there are no more."""
    keep = np.sort(np.argsort(-weight.astype(np.float64), kind="stable")[:count])
    return {name: values[keep] for name, values in layers.items()}


def fitted(
    layers: Mapping[str, np.ndarray], paths: Mapping[str, np.ndarray], weight: np.ndarray, limit: int
) -> tuple[list[dict[str, Any]], str, int]:
    """Pack into at most `limit` characters, with fewer Gaussians if needed; the last item is their number.

    The Gaussians of largest weight are kept; `paths` stay complete. The paths of some 15,000 frames fill the limit
    alone, and then no Gaussian is kept.
    """
    count = len(weight)
    about, text = packed({**layers, **paths})
    while len(text) > limit and count:
        count = int(0.95 * count * limit / len(text))
        about, text = packed(thinned(layers, weight, count) | dict(paths))
    return about, text, count


def packed(arrays: Mapping[str, np.ndarray]) -> tuple[list[dict[str, Any]], str]:
    """Describe arrays, and pack their bytes: column by column, little-endian, deflated, in base64.

    Columns of one kind, with the first bytes of all numbers before the second ones, deflate to two thirds.
    """
    about, parts, offset = [], [], 0
    for name, values in arrays.items():
        values = np.ascontiguousarray(values)
        columns = np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T)
        raw = columns.astype(columns.dtype.newbyteorder("<")).view(np.uint8).reshape(-1, columns.dtype.itemsize)
        parts.append(np.ascontiguousarray(raw.T).tobytes())
        about.append({"name": name, "type": values.dtype.name, "rows": len(values), "columns": len(columns)})
        about[-1]["offset"] = offset
        offset += len(parts[-1])
    return about, base64.b64encode(zlib.compress(b"".join(parts), 9)).decode("ascii")
