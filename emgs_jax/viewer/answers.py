"""Answers of the viewer: Gaussians that are close to words, and the one under a ray."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import matplotlib
import numpy as np

from emgs_jax.drawing.colors import to_bytes
from emgs_jax.semantics import answers

REACH = 3.0  # standard deviations from its centre at which a Gaussian still stops a ray
SURFACE = 0.03  # of the distance; Gaussians this near behind the first one belong to its surface
_answers = eqx.filter_jit(answers)
Layers = Mapping[str, np.ndarray]  # of `layers.map_layers`, perhaps with `feature_layer`


class Answer(NamedTuple):
    """Result of a query for words in a map."""

    cosines: np.ndarray  # of each Gaussian with the closest wanted word, (n,) in [0, 1]
    is_found: np.ndarray  # (n,), closer to that word than to all rivals, and close enough


def find_words(text: str, names: Sequence[str]) -> tuple[list[int], int]:
    """Find the rows of class names in a text with commas, and count its words that are no class.

    An incomplete word stands for the class that begins with it, if there is only one.
    """
    words = [word.strip().casefold() for word in text.split(",") if word.strip()]
    known, rows, num_unknown = [name.casefold() for name in names], [], 0
    for word in words:
        begun = [row for row, name in enumerate(known) if name.startswith(word)]
        found = [known.index(word)] if word in known else begun if len(begun) == 1 else []
        rows += found
        num_unknown += not found
    return rows, num_unknown


def ask(layers: Layers, wanted: Sequence[int], against: Sequence[int], min_cosine: float) -> Answer:
    """Search a map with classes for words, as `semantics.answers` does without a margin.

    `wanted` holds the rows of the words to find, at least one; `against` those of rivals.
    """
    count = len(layers["label"])
    fill = (0, (1 << (count - 1).bit_length()) - count)  # few sizes, as each compiles once
    cosines = np.pad(layers["similarity"], (fill, (0, 0))).astype(np.float32) / 255.0
    words, rivals = (jnp.asarray(cosines[:, [*rows]]) for rows in (wanted, against))
    is_known, limits = jnp.asarray(np.pad(layers["label"] >= 0, fill)), jnp.asarray([0.0, min_cosine], jnp.float32)
    found = _answers(words, rivals, is_known, *limits)
    return Answer(cosines[:count, [*wanted]].max(axis=1), np.asarray(found.labels)[:count] >= 0)


def highlighted(colors: np.ndarray, answer: Answer) -> np.ndarray:
    """Return colours (n, 3), uint8: found Gaussians in the colour of their cosine, everything else dark."""
    hot = matplotlib.colormaps["inferno"](0.5 + 0.5 * answer.cosines)[:, :3]
    return to_bytes(np.where(answer.is_found[:, None], 0.25 * colors / 255.0 + 0.75 * hot, 0.25 * colors / 255.0))


def picked(means: np.ndarray, covs: np.ndarray, origin: Sequence[float], direction: Sequence[float]) -> int | None:
    """Find the Gaussian that a ray meets nearest to its centre on the first surface; None without one.

    Gaussians behind the origin do not count.
    """
    ray, offsets = np.asarray(direction, np.float64), np.asarray(means, np.float64) - np.asarray(origin, np.float64)
    if not len(means):
        return None
    precisions = np.linalg.inv(np.asarray(covs, np.float64))
    weighted = precisions @ ray
    along = np.einsum("ni,ni->n", weighted, offsets) / (weighted @ ray)  # where the ray is nearest, by the covariance
    rest = offsets - along[:, None] * ray
    distances_sq = np.einsum("ni,nij,nj->n", rest, precisions, rest)
    is_met = (along > 0) & (distances_sq <= REACH**2)
    if not is_met.any():
        return None
    is_first = is_met & (along <= (1 + SURFACE) * along[is_met].min())
    return int(np.argmin(np.where(is_first, distances_sq, np.inf)))
