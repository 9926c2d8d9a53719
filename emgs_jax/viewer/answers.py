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
SURFACE = 0.03  # of the distance; Gaussians that are met so near behind the first are of one surface with it
_answers = eqx.filter_jit(answers)
Layers = Mapping[str, np.ndarray]  # as `layers.map_layers` makes them, perhaps with `feature_layer`


class Answer(NamedTuple):
    """Result of a query for words in a map."""

    cosines: np.ndarray  # of each Gaussian with the closest word that is asked for, (n,) in [0, 1]
    is_found: np.ndarray  # (n,), closer to it than to all rivals, and close enough


def find_words(text: str, names: Sequence[str]) -> tuple[list[int], int]:
    """Find rows of the class names in a text, words apart by commas, and how many of its words are no class.

    A word that is being typed is the class that begins with it, where there is only one.
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
    """Look for words in a map with classes, as `semantics.answers` does without a margin.

    Rows of the words that are asked for, at least one, are `wanted`; those of rivals are `against`.
    """
    count = len(layers["label"])
    fill = (0, (1 << (count - 1).bit_length()) - count)  # few sizes, as each compiles once
    cosines = np.pad(layers["similarity"], (fill, (0, 0))).astype(np.float32) / 255.0
    words, rivals = (jnp.asarray(cosines[:, [*rows]]) for rows in (wanted, against))
    is_known, limits = jnp.asarray(np.pad(layers["label"] >= 0, fill)), jnp.asarray([0.0, min_cosine], jnp.float32)
    found = _answers(words, rivals, is_known, *limits)
    return Answer(cosines[:count, [*wanted]].max(axis=1), np.asarray(found.labels)[:count] >= 0)


def highlighted(colors: np.ndarray, answer: Answer) -> np.ndarray:
    """Return colours (n, 3), uint8, with what was found in the colour of its cosine, and everything else dark."""
    hot = matplotlib.colormaps["inferno"](0.5 + 0.5 * answer.cosines)[:, :3]
    return to_bytes(np.where(answer.is_found[:, None], 0.25 * colors / 255.0 + 0.75 * hot, 0.25 * colors / 255.0))


def picked(means: np.ndarray, covs: np.ndarray, origin: Sequence[float], direction: Sequence[float]) -> int | None:
    """Find the Gaussian that a ray meets nearest to its centre on the first surface; None where there is none.

    What lies behind the origin is not met.
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
