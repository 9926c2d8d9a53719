"""Open-set queries (Experiments C): every Gaussian gets the class whose text embedding is closest to its feature."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians, has_feature
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.precision import full_precision

MIN_SPREAD = 1e-3  # of unit features along a direction; a smaller spread is rounding


class Relevance(eqx.Module):
    """Similarity of a map's Gaussians to c words.

    Args:
        cosines: of every Gaussian's feature with each word; 0 without a feature.
        leads: cosine minus the largest one with any other word or rival; cosine plus 1 without another. Positive only
            for the closest word.
        labels: the word that a Gaussian answers to, -1 for none.
    """

    cosines: Float[Array, "n c"]
    leads: Float[Array, "n c"]
    labels: Int[Array, "n"]


@full_precision
def similarities(gaussians: Gaussians, text_features: Float[Array, "c f"]) -> Float[Array, "n c"]:
    """Compute the cosine of every Gaussian's feature with every class's text embedding; 0 without a feature."""
    products = gaussians.features @ safe_normalize(text_features).T
    squared = gaussians.features**2 @ jnp.ones((text_features.shape[-1], 1))  # a sum would take longer than the product
    return jnp.where(squared > 0, products / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


@full_precision
def classify(gaussians: Gaussians, text_features: Float[Array, "c f"]) -> Int[Array, "n"]:
    """Classify every Gaussian; -1 for invalid rows and for Gaussians without a feature.

    Raises:
        ValueError: the embeddings' width differs from the map's, or there is no class.
    """
    _check_width(gaussians, text_features)
    return jnp.where(_is_known(gaussians), jnp.argmax(similarities(gaussians, text_features), axis=-1), -1)


@full_precision
def relevance(
    gaussians: Gaussians,
    words: Float[Array, "c f"],
    rivals: Float[Array, "r f"],
    margin: Float[Array, ""],
    min_cosine: Float[Array, ""],
) -> Relevance:
    """Search for words: a Gaussian answers to the closest one, unless a rival or another word is nearly as close.

    Args:
        gaussians: invalid rows and those without a feature answer to nothing.
        words: text embeddings, of any norm but 0.
        rivals: embeddings of words that are not searched for; may be empty.
        margin: smallest lead of an answer.
        min_cosine: smallest cosine of an answer.

    Raises:
        ValueError: the embeddings' width differs from the map's, or there is no word.
    """
    _check_width(gaussians, words)
    known, count = similarities(gaussians, jnp.concatenate([words, rivals])), words.shape[0]
    return answers(known[:, :count], known[:, count:], _is_known(gaussians), margin, min_cosine)


def answers(
    words: Float[Array, "n c"],
    rivals: Float[Array, "n r"],
    is_known: Bool[Array, "n"],
    margin: Float[Array, ""],
    min_cosine: Float[Array, ""],
) -> Relevance:
    """Decide `relevance` from cosines; a rival that is as close as the closest word wins.

    Args:
        words: cosine of every Gaussian with each word that is searched for, at least one.
        is_known: False for Gaussians that cannot answer.
    """
    count, known = rivals.shape[-1], jnp.concatenate([rivals, words], axis=-1)
    best = jnp.argmax(known, axis=-1)  # the first of equals
    is_best = jnp.arange(known.shape[-1]) == best[:, None]
    highest = jnp.max(known, axis=-1, keepdims=True)
    second = jnp.max(jnp.where(is_best, -1.0, known), axis=-1, keepdims=True)
    is_best = is_best[:, count:]
    leads = words - jnp.where(is_best, second, highest)
    is_answer = is_best & (leads >= margin) & (words >= min_cosine)
    is_answer &= is_known[:, None]
    labels = jnp.where(jnp.any(is_answer, axis=-1), jnp.argmax(is_answer, axis=-1), -1)
    return Relevance(words, leads, labels)


@full_precision
def principal_colors(gaussians: Gaussians) -> Float[Array, "n 3"]:
    """Colour features by their coordinates along their three principal directions, as RGB in [0, 1].

    Each direction's sign makes its largest entry positive; 98 % of the Gaussians span 0 to 1. Grey (.5) marks a
    direction without variation, an invalid row, and a Gaussian without a feature.
    """
    is_known = _is_known(gaussians)
    count = jnp.maximum(jnp.sum(is_known), 1)
    units = jnp.where(is_known[:, None], safe_normalize(gaussians.features), 0.0)
    centered = jnp.where(is_known[:, None], units - jnp.sum(units, axis=0) / count, 0.0)
    _, directions = jnp.linalg.eigh(centered.T @ centered / count)
    directions = jnp.pad(directions[:, ::-1], ((0, 0), (0, 3)))[:, :3]
    largest = jnp.take_along_axis(directions, jnp.argmax(jnp.abs(directions), axis=0)[None], axis=0)
    along = centered @ jnp.where(largest < 0, -directions, directions)
    low, high = jnp.nanpercentile(jnp.where(is_known[:, None], along, jnp.nan), jnp.array([1.0, 99.0]), axis=0)
    is_spread = high - low > MIN_SPREAD  # False without any feature, when both ends are NaN
    shares = (along - jnp.where(is_spread, low, 0.0)) / jnp.where(is_spread, high - low, 1.0)
    return jnp.where(is_spread & is_known[:, None], jnp.clip(shares, 0.0, 1.0), 0.5)


def _is_known(gaussians: Gaussians) -> Bool[Array, "n"]:
    return gaussians.valid & has_feature(gaussians.features)


def _check_width(gaussians: Gaussians, text_features: Float[Array, "c f"]) -> None:
    if text_features.shape[0] == 0 or text_features.shape[1] != gaussians.features.shape[-1]:
        raise ValueError(
            f"text_features must be (classes, {gaussians.features.shape[-1]}) like the map's features, "
            f"got {tuple(text_features.shape)}: embed the classes with the model that made the map's features"
        )
