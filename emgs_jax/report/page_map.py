"""The map as the page gets it: layers of a few bytes a Gaussian, packed into one block of text."""

import base64
import math
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from emgs_jax.features.text import TextEmbeddings
from emgs_jax.gaussian_map import GaussianMap, confirmed
from emgs_jax.report.display import closing_covariances
from emgs_jax.running.convert import on_device
from emgs_jax.running.executables import stored
from emgs_jax.semantics import principal_colors, similarities

COV_UNIT = 1e-4  # m²; float16 then holds standard deviations from .1 mm to 2.5 m
_LARGEST_HALF = 65504.0
_similarities, feature_colors = stored(similarities), stored(principal_colors)
_UPPER = np.triu_indices(3)


def map_layers(map: GaussianMap, text: TextEmbeddings | None) -> dict[str, np.ndarray]:
    """Return the attributes of each confirmed Gaussian that the page shows, in the order of the map.

    Returns:
        `mean` float32 (n, 3) in metres; `cov` float16 (n, 6), the upper triangle of `closing_covariances` in
        `COV_UNIT`; `color` uint8 (n, 3); `normal` int8 (n, 3), 127 = 1; `existence` uint8, the probability that it
        stands for something, 255 = 1; `updates` uint16; `birth` int32, the node of its first frame. With text, `label`
        int16, -1 = none, and `similarity` uint8 (n, c): the cosine with each class, 255 = 1, what is negative is 0.
    """
    gaussians = jax.device_get(confirmed(map))
    rows = np.flatnonzero(gaussians.valid)
    means, covs, normals = (np.asarray(x)[rows] for x in (gaussians.means, gaussians.covs, gaussians.normals))
    covs = closing_covariances(means, covs, normals)[:, _UPPER[0], _UPPER[1]] / COV_UNIT
    layers = {
        "mean": means.astype(np.float32),
        "cov": np.clip(covs, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16),
        "color": _bytes(np.asarray(gaussians.colors)[rows]),
        "normal": np.rint(127 * normals).astype(np.int8),
        "existence": _bytes(1.0 / (1.0 + np.exp(-np.asarray(map.existence, np.float64)[rows]))),
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
    return layers | {"label": labels, "similarity": _bytes(cosines)}


def feature_layer(map: GaussianMap) -> dict[str, np.ndarray]:
    """`feature` uint8 (n, 3), the main directions of the features as RGB (`principal_colors`); empty without features.

    Rows as in `map_layers`.
    """
    gaussians = confirmed(map)
    rows = np.flatnonzero(gaussians.valid)
    if not np.asarray(gaussians.features)[rows].any():
        return {}
    return {"feature": _bytes(np.asarray(feature_colors(gaussians))[rows])}


def thinned(layers: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """The `count` Gaussians that most frames agree on, in their order; all of them where there are no more."""
    order = np.argsort(-layers["updates"].astype(np.int64), kind="stable")[:count]
    keep = np.sort(order)
    return {name: values[keep] for name, values in layers.items()}


def fitted(
    layers: Mapping[str, np.ndarray], paths: Mapping[str, np.ndarray], limit: int
) -> tuple[list[dict[str, Any]], str, str]:
    """As `packed`, at most `limit` characters: with fewer Gaussians where all of them are too many; the last says so.

    The paths of some 15,000 frames are too many by themselves: then there is no Gaussian.
    """
    count = whole = len(layers["mean"])
    about, text = packed({**layers, **paths})
    while len(text) > limit and count:
        count = int(0.95 * count * limit / len(text))
        about, text = packed(thinned(layers, count) | dict(paths))
    note = f"The page shows the {count:,} of {whole:,} Gaussians that most frames agree on; map.npz has all of them."
    return about, text, note if count < whole else ""


def packed(arrays: Mapping[str, np.ndarray]) -> tuple[list[dict[str, Any]], str]:
    """Arrays as a list of what they are, and their bytes: column by column, little-endian, deflated, in base64.

    Columns of one kind, and the first bytes of all numbers before their second ones, deflate to two thirds.
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


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.nan_to_num(values).clip(0.0, 1.0)).astype(np.uint8)
